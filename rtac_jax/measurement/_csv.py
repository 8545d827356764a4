"""Text files with a header row: import with an explicit channel mapping, and what a rig can play."""

import csv
import itertools
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TypeVar

import numpy as np
from jaxtyping import Float64

from ._columns import ImportOptions, imported
from ._contents import Contents
from ._errors import RecordingError
from ._experiment import Experiment
from ._stated_unit import FACTORS, name_and_unit, usual_spelling
from .atomic_write import replacing

Read = TypeVar("Read")
_ENCODINGS = (
    "utf-8-sig",
    "cp1252",
)  # the first drops the mark that spreadsheets put at the start; the other is what loggers write
_PREAMBLE = 100  # rows in which the names of the columns are looked for
_NAMED = {"tab": "\t", "\\t": "\t", "space": " "}  # delimiters that a shell makes hard to write
_MARKS = {",": "comma", ".": "point"}
_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}")


def read(
    path: str | os.PathLike[str], channels: Mapping[str, str], kind: str, delimiter: str, options: ImportOptions
) -> tuple[Experiment, Mapping[str, float]]:
    """Return the experiment in a CSV file, and the constants of its rig; see `Recording.from_csv`."""
    mark = _mark(delimiter)
    header = csv_header(path, delimiter)
    told: ImportOptions = {**options}
    if isinstance(time := options.get("time"), str):
        told["time"] = _stated(time, header)
    named = {channel: _stated(column, header) for channel, column in channels.items()}
    return imported(path, lambda names: _read_columns(path, names, mark), named, kind, told)


def _stated(column: str, header: list[str]) -> str:
    """Return a column by the name that the file gives it with its unit, as "x [mm]" for "x" above a row of units."""
    named = [cell for cell in header if name_and_unit(cell)[0] == column != cell]
    return named[0] if len(named) == 1 and column not in header else column


def csv_header(path: str | os.PathLike[str], delimiter: str = ",") -> list[str]:
    """Return the names of the columns of a text file: in its first row, or below what a logger writes above them.

    Raises:
        FileNotFoundError: there is no such file.
        RecordingError: it is no text file, or the delimiter is not one character.
    """
    delimiter = _mark(delimiter)
    try:
        names = _opened(path, delimiter, _names)
    except RecordingError as error:
        raise RecordingError(f"{os.fspath(path)}: {error}") from error.__cause__
    return names


def _mark(delimiter: str) -> str:
    return _NAMED.get(delimiter, delimiter) if isinstance(delimiter, str) else delimiter


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
        raise RecordingError(f"delimiter: is {delimiter!r}; give one character, as ',' or ';', or tab.")
    reason: Exception = ValueError(path)
    for encoding in _ENCODINGS:
        try:
            with open(path, newline="", encoding=encoding) as file:
                if "\0" in file.read(4096):
                    raise csv.Error("it holds zero bytes")
                file.seek(0)
                return read(csv.reader(file, delimiter=delimiter))
        except UnicodeDecodeError as error:
            reason = error
        except (OSError, csv.Error) as error:
            reason = error
            break
    raise RecordingError(f"this is not a readable text file ({reason}); save it as CSV in UTF-8.") from reason


def _names(rows: Iterable[list[str]]) -> list[str]:
    """Return the names of the columns, as far as a file tells them.

    They are the first row above the numbers with as many cells as these and none that is empty or a number: a logger may write
    about itself above, and units below. It is the first row of all where there is none.
    """
    above = [[cell.strip() for cell in cells] for cells in itertools.islice(rows, _PREAMBLE)]
    numbers = next((cells for cells in above[1:] if _is_numbers(cells)), [])
    first = above[: above.index(numbers)] if numbers else []
    several = [*map(_trimmed, first), *(_words(cells) for cells in first[-1:])]
    wide = [cells for cells in several if len(cells) == len(_trimmed(numbers))]
    named = (cells for cells in wide if all(cells) and all(_value(cell) is None for cell in cells))
    found = next(named, above[0] if above else [])
    _require_names(above, found)
    place = above.index(found) + 1 if found in above else len(above)
    return _with_units(found, above[place] if place < len(above) else [])


def _with_units(names: list[str], below: list[str]) -> list[str]:
    """Return names with the units of the row below them, as "x [mm]"; as they are where that row holds none."""
    units = _trimmed(below)
    told = [unit.strip("[]() ") for unit in units if unit]
    known = sum(any(usual_spelling(unit) in factors for factors in FACTORS.values()) for unit in told)
    if len(units) != len(names) or any(_value(unit) is not None for unit in told) or 2 * known <= len(told):
        return names
    cells = [(name, unit.strip("[]() ")) for name, unit in zip(names, units, strict=True)]
    return [f"{name} [{unit}]" if unit and not name_and_unit(name)[1] else name for name, unit in cells]


def _words(cells: list[str]) -> list[str]:
    """Return the words of a row that has a single cell, as names have spaces between them over columns that have something else."""
    return cells[0].split() if len(cells) == 1 else []


def _is_numbers(cells: list[str]) -> bool:
    """Return whether most cells of a row that are not empty are numbers."""
    told = [cell for cell in cells if cell]
    return sum(_value(cell) is not None for cell in told) > len(told) / 2


def _parse(rows: Iterable[list[str]], names: list[str], delimiter: str) -> dict[str, Float64[np.ndarray, " sample"]]:
    numbered = enumerate(rows, start=1)
    header, numbered = _header(numbered, names, delimiter)
    places = [header.index(name) for name in names]
    columns: dict[str, list[float]] = {name: [] for name in names}
    marks = {name: _Marks() for name in names}
    blank, begun = None, False
    for row, cells in numbered:
        if not cells:
            blank = row
            continue
        # Blank lines at the end are harmless; one in the middle may be a missing sample.
        if blank is not None and begun:
            raise RecordingError(f"row {blank}: is empty; remove it, or write nan for missing samples.")
        if len(cells) > len(header) and not any(cell.strip() for cell in cells[len(header) :]):
            cells = cells[: len(header)]  # a mark at the end of a row
        if len(cells) != len(header):
            raise RecordingError(f"row {row}: has {len(cells)} cells, but the header has {len(header)}; mend the row.")
        wanted = [cells[place].strip() for place in places]
        if not begun and any(wanted) and all(_value(cell) is None for cell in wanted if cell):
            continue  # units below the names
        begun = True
        for name, cell in zip(names, wanted, strict=True):
            columns[name].append(_number(cell, row, name))
            marks[name].note(cell, row, name)
    for name, seen in marks.items():
        seen.require_decimals(name)
    return {name: np.array(values, dtype=np.float64) for name, values in columns.items()}


def _header(
    numbered: Iterator[tuple[int, list[str]]], names: list[str], delimiter: str
) -> tuple[list[str], Iterator[tuple[int, list[str]]]]:
    """Return the row that holds the names of the columns, and what comes below with its row numbers.

    Where no row has them as its cells, those that stand right above the numbers are split at spaces.

    Raises:
        RecordingError: none of the first rows holds them, once each; of the first one it says which is missing.
    """
    above = list(itertools.islice(numbered, _PREAMBLE))
    rows = [[cell.strip() for cell in cells] for _, cells in above]
    end = next((place for place, cells in enumerate(rows) if place and _all_numbers(cells)), len(rows))
    several = [
        *enumerate(rows[: end + 1]),
        *((end - 1, _words(cells)) for cells in rows[end - 1 : end] if end < len(rows)),
    ]
    for place, header in several:
        if all(header.count(name) == 1 for name in names):
            _require_names(rows[place:], header)
            return _trimmed(header), itertools.chain(above[place + 1 :], numbered)
        joined = _with_units(_trimmed(header), rows[place + 1] if place + 1 < len(rows) else [])
        if all(joined.count(name) == 1 for name in names):
            return joined, itertools.chain(above[place + 2 :], numbered)
    first = next((cells for cells in rows if cells), [])
    _require_names(rows, first)
    for name in names:
        if first.count(name) != 1:
            often = "does not occur" if name not in first else "occurs more than once"
            raise RecordingError(
                f"row 1: the column {name!r} {often} in the header ({', '.join(first)}); name the columns in one row above the"
                f" numbers and separate them by {delimiter!r}."
            )
    raise RecordingError("the file is empty.")


def _all_numbers(cells: list[str]) -> bool:
    told = _trimmed(cells)
    return bool(told) and all(_value(cell) is not None for cell in told)


def _trimmed(cells: list[str]) -> list[str]:
    """Return the cells of a row without empty ones at its end, as after a mark there."""
    count = max((place + 1 for place, cell in enumerate(cells) if cell), default=0)
    return cells[:count]


def _require_names(rows: list[list[str]], header: list[str]) -> None:
    """Refuse numbers above numbers in the place of names; whole numbers, each once, may be those of the columns.

    Raises:
        RecordingError: they are no names.
    """
    numbers = [_value(cell) for cell in header]
    below = next((cells for cells in rows[1:] if cells), [])
    alike = len(_trimmed(below)) == len(header) and _all_numbers(below)
    whole = all(cell.isdigit() for cell in header) and len(set(header)) == len(header)
    if numbers and None not in numbers and alike and not whole:
        raise RecordingError(
            f"row 1: holds numbers ({', '.join(header)}) and no names; write a row with the names of the columns above the numbers."
        )


class _Marks:
    """The decimal marks of one column, with the rows in which they were seen first."""

    def __init__(self) -> None:
        self.rows: dict[str, int] = {}
        self.plain, self.thousands = False, True

    def note(self, cell: str, row: int, name: str) -> None:
        """Note the mark of a number.

        Raises:
            RecordingError: the column has a decimal point and a decimal comma.
        """
        mark = next((mark for mark in _MARKS if mark in cell), None)
        if mark is None:
            self.plain |= bool(cell)
            return
        self.rows.setdefault(mark, row)
        self.thousands &= mark == "," and _THOUSANDS.fullmatch(cell) is not None
        if len(self.rows) > 1:
            told = " and ".join(f"a decimal {_MARKS[mark]} in row {at}" for mark, at in self.rows.items())
            raise RecordingError(f"column {name!r}: numbers have {told}; write all of them with a point.")

    def require_decimals(self, name: str) -> None:
        """Refuse whole numbers beside commas that may as well set off their thousands.

        Raises:
            RecordingError: every comma stands before three digits.
        """
        if "," in self.rows and self.plain and self.thousands:
            raise RecordingError(
                f"column {name!r}: the comma in row {self.rows[',']} may set off thousands; write numbers without it, or with a"
                " decimal point."
            )


def _number(cell: str, row: int, name: str) -> float:
    cell = cell.strip()
    if not cell:
        return math.nan
    if (value := _value(cell)) is not None:
        return value
    raise RecordingError(
        f"row {row}, column {name!r}: {cell!r} is not a number; write it with a decimal point, or leave the cell empty."
    )


def _value(cell: str) -> float | None:
    """Return the number in a cell, with a decimal point or comma; None where it holds none.

    A comma within a cell separates no columns: another character does, or the cell stands between quotes.
    """
    if cell.count(",") == 1 and "." not in cell:
        cell = cell.replace(",", ".")
    try:
        # Python reads 1_5 as fifteen; in a file it is a slip.
        return None if "_" in cell else float(cell)
    except ValueError:
        return None
