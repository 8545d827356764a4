"""Text files with a header row: import with an explicit channel mapping, and what a rig can play."""

import csv
import math
import os
from collections.abc import Callable, Iterable, Mapping
from typing import TypeVar

import numpy as np
from jaxtyping import Float64

from ._columns import ImportOptions, imported
from ._contents import Contents
from ._errors import RecordingError
from ._experiment import Experiment
from .atomic_write import replacing

Read = TypeVar("Read")


def read(
    path: str | os.PathLike[str], channels: Mapping[str, str], kind: str, delimiter: str, options: ImportOptions
) -> tuple[Experiment, Mapping[str, float]]:
    """Return the experiment in a CSV file, and the constants of its rig; see `Recording.from_csv`."""
    return imported(path, lambda names: _read_columns(path, names, delimiter), channels, kind, options)


def csv_header(path: str | os.PathLike[str], delimiter: str = ",") -> list[str]:
    """Return the names in the first row of a text file.

    Raises:
        FileNotFoundError: there is no such file.
        RecordingError: it is no text file, or the delimiter is not one character.
    """
    return _opened(path, delimiter, lambda rows: [cell.strip() for cell in next(iter(rows), [])])


def write(path: str | os.PathLike[str], recording: Contents) -> None:
    """Write the one experiment of `recording` as CSV; see `Recording.save`."""
    experiments = recording.experiments
    if len(experiments) != 1:
        raise RecordingError(
            f"{os.fspath(path)}: a CSV file holds one experiment, and this recording has {len(experiments)}; save it as .h5."
        )
    (experiment,) = experiments
    channels = {**experiment.inputs, **experiment.outputs}
    columns = {"time [s]": experiment.sample_time * np.arange(experiment.samples)}
    columns |= {f"{name} [{signal.unit}]": signal.values for name, signal in channels.items()}
    with replacing(path) as temporary, open(temporary, "x", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        for row in zip(*columns.values(), strict=True):
            writer.writerow("" if math.isnan(value) else repr(float(value)) for value in row)


def _read_columns(
    path: str | os.PathLike[str], names: Iterable[str], delimiter: str
) -> dict[str, Float64[np.ndarray, " sample"]]:
    return _opened(path, delimiter, lambda rows: _parse(rows, list(dict.fromkeys(names)), delimiter))


def _opened(path: str | os.PathLike[str], delimiter: str, read: Callable[[Iterable[list[str]]], Read]) -> Read:
    if not os.path.exists(path):
        raise FileNotFoundError(f"{os.fspath(path)}: there is no such file; check the path.")
    if not (isinstance(delimiter, str) and len(delimiter) == 1 and delimiter not in '"\r\n'):
        raise RecordingError(f"delimiter: is {delimiter!r}; give one character, as ',' or ';'.")
    try:
        # utf-8-sig drops the mark that spreadsheets put at the start, which would become part of the first
        # name.
        with open(path, newline="", encoding="utf-8-sig") as file:
            return read(csv.reader(file, delimiter=delimiter))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise RecordingError(f"this is not a readable text file ({error}); save it as CSV in UTF-8.") from error


def _parse(rows: Iterable[list[str]], names: list[str], delimiter: str) -> dict[str, Float64[np.ndarray, " sample"]]:
    numbered = enumerate(rows, start=1)
    _, header = next(numbered, (1, []))
    header = [cell.strip() for cell in header]
    for name in names:
        if header.count(name) != 1:
            often = "does not occur" if name not in header else "occurs more than once"
            raise RecordingError(
                f"row 1: the column {name!r} {often} in the header ({', '.join(header)}); name the columns "
                f"in the first row and separate them by {delimiter!r}."
            )
    places = [header.index(name) for name in names]
    columns: dict[str, list[float]] = {name: [] for name in names}
    blank = None
    for row, cells in numbered:
        if not cells:
            blank = row
            continue
        # Blank lines at the end are harmless; one in the middle may be a missing sample.
        if blank is not None:
            raise RecordingError(f"row {blank}: is empty; remove it, or write nan for missing samples.")
        if len(cells) != len(header):
            raise RecordingError(f"row {row}: has {len(cells)} cells, but the header has {len(header)}; mend the row.")
        for name, place in zip(names, places, strict=True):
            columns[name].append(_number(cells[place], row, name))
    return {name: np.array(values, dtype=np.float64) for name, values in columns.items()}


def _number(cell: str, row: int, name: str) -> float:
    cell = cell.strip()
    if not cell:
        return math.nan
    try:
        # Python reads 1_5 as fifteen; in a file it is a slip.
        if "_" not in cell:
            return float(cell)
    except ValueError:
        pass
    raise RecordingError(
        f"row {row}, column {name!r}: {cell!r} is not a number; write it with a decimal point, or leave the cell empty."
    )
