"""Conversion of named columns of a foreign file to a recording of one experiment, shared by the MAT and CSV importers."""

import os
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
from jaxtyping import Bool, Float64

from ._clock import nearest_clock, resampled, said_twice, uniform_step
from ._errors import RecordingError
from ._experiment import Experiment
from ._mending import mended, places_of_rows, with_rows
from ._momentary_faults import faulty
from ._signal import INPUTS, OUTPUTS, finite, positive
from ._stated_unit import FACTORS, ending_unit, name_and_unit, usual_spelling

UNITS = {**INPUTS, **OUTPUTS}


class ImportOptions(TypedDict, total=False):
    """The options of `Recording.from_mat` and `Recording.from_csv` beside a file's channels and its kind.

    Attributes:
        time: name of the column with the times; either this or `sample_time` [s] is given.
        sample_time: [s].
        name: of the experiment; that of the file where it is not given.
        units: of the file by channel, and of "time" ("mm", "deg/s", "ms", ...). Where absent, what the column's name states, as
            "x [mm]", "x (mm)" or "speed_rpm" do, and that of the layout where it states none.
        scale: factor of your own by channel, the layout's unit per unit of the column.
        start, stop: samples that are taken, from `start` up to but without `stop`.
        remove_mean: channels that lose their mean over these.
        unwrap: take jumps of whole turns out of arm_angle, as of an encoder that begins again after a turn.
        mend: drop rows that a logger wrote twice, put those that it lost, as the times tell, back as missing samples (inputs run
            on), and make samples missing that are no measurement; see `Recording.mended`.
        resample: seconds between the samples to which rows at uneven times are brought: outputs by straight lines between rows that
            are no gap, and inputs that are held as they are in the middle of a sample's interval. The noise of what lies between
            two rows is less than theirs.
        rig: constants, each with an optional `NAME_std`, as in `Recording`.
        intersample, noise_std, initial_arm_angle, initial_arm_angle_std, arm, cart: as in `Experiment.of`.
    """

    time: str | None
    sample_time: float | None
    name: str | None
    units: Mapping[str, str] | None
    scale: Mapping[str, float] | None
    start: int
    stop: int | None
    remove_mean: Collection[str]
    unwrap: bool
    mend: bool
    resample: float | None
    rig: Mapping[str, float] | None
    intersample: str | Mapping[str, str]
    noise_std: Mapping[str, float] | None
    initial_arm_angle: float | None
    initial_arm_angle_std: float | None
    arm: str
    cart: str


def imported(
    path: str | os.PathLike[str],
    read: Callable[[list[str]], Mapping[str, Float64[np.ndarray, " sample"]]],
    channels: Mapping[str, str],
    kind: str,
    options: ImportOptions,
) -> tuple[Experiment, Mapping[str, float]]:
    """Return the one experiment in a foreign file, and the constants of its rig; `read` returns the columns of these names.

    Raises:
        RecordingError: names the column, option or sample that is wrong.
    """
    told: dict[str, Any] = dict(options)
    name, rig = told.pop("name", None), told.pop("rig", None)
    by_channel = {key: options.get(key) for key in ("units", "scale", "remove_mean")}
    wanted = check_options(channels, options.get("time"), options.get("sample_time"), by_channel)
    try:
        experiment = assemble(
            read(wanted), name=Path(path).stem if name is None else name, channels=channels, kind=kind, **told
        )
    except RecordingError as error:
        raise RecordingError(f"{os.fspath(path)}: {error}") from error.__cause__
    return experiment, rig or {}


def check_options(
    channels: Mapping[str, str],
    time: str | None,
    sample_time: float | None,
    by_channel: Mapping[str, Collection[str] | None],
) -> list[str]:
    """Return the columns to read.

    Raises:
        RecordingError: a channel is unknown, or the time is given twice or not.
    """
    if not channels:
        raise RecordingError(f"channels: is empty; map at least one of {', '.join(UNITS)} to a name in the file.")
    for channel in channels:
        if channel not in UNITS:
            raise RecordingError(f"channels: there is no channel {channel!r}; use {', '.join(UNITS)}.")
    for option, keys in by_channel.items():
        for key in keys or ():
            if key not in channels and not (option == "units" and key == "time" and time is not None):
                raise RecordingError(f"{option}: names {key!r}, which is not among the channels; add it there.")
    if (time is None) == (sample_time is None):
        raise RecordingError("time, sample_time: give one of the two, the column of times or the seconds per sample.")
    return [*channels.values(), *([time] if time is not None else [])]


def assemble(
    columns: Mapping[str, Float64[np.ndarray, " sample"]],
    *,
    name: str,
    channels: Mapping[str, str],
    time: str | None = None,
    sample_time: float | None = None,
    units: Mapping[str, str] | None = None,
    scale: Mapping[str, float] | None = None,
    remove_mean: Collection[str] = (),
    unwrap: bool = False,
    mend: bool = False,
    resample: float | None = None,
    start: int = 0,
    stop: int | None = None,
    **conditions: Any,
) -> Experiment:
    """Return the experiment in samples `start` to `stop` of the columns, in the units of the layout.

    Raises:
        RecordingError: lengths differ, the samples do not exist, or the times are not uniform.
    """
    lengths = {column: len(values) for column, values in columns.items()}
    total = min(lengths.values())
    if total != max(lengths.values()):
        raise RecordingError(f"the lengths differ ({lengths}); all columns of an experiment must have one length.")
    if resample is not None and time is None:
        raise RecordingError("resample: needs the times of the rows; give time instead of sample_time.")
    stop = total if stop is None else stop
    if not 0 <= start < stop <= total:
        raise RecordingError(f"samples {start} to {stop} were asked for; choose 0 <= start < stop <= {total}.")
    signals = {}
    for channel, column in channels.items():
        values = columns[column][start:stop] * _factor(channel, column, units or {}, scale or {})
        if unwrap and channel == "arm_angle":
            values = _unwrapped(values, conditions.get("initial_arm_angle"))
        # Missing samples do not take part in a mean; a column without any is refused further on.
        present = values[~np.isnan(values)]
        if channel in remove_mean and len(present):
            values = values - present.mean()
        signals[channel] = values
    if time is not None:
        seconds = columns[time][start:stop] * _factor("time", time, units or {}, {})
        if mend and (again := said_twice(seconds, signals)).any():
            seconds, signals = seconds[~again], {c: x[~again] for c, x in signals.items()}
        places = places_of_rows(seconds)
        between = conditions.get("intersample", "zoh")
        inputs = [c for c in channels if c in INPUTS]
        held = [c for c in inputs if (between if isinstance(between, str) else between.get(c, "zoh")) == "zoh"]
        if resample is not None:
            if mend:  # or a fault would be half of what lies beside it
                signals = {c: np.where(_is_faulty(c, x), np.nan, x) for c, x in signals.items()}
            signals, sample_time = resampled(signals, seconds, resample, time, held=held), resample
        elif places is not None and mend:
            signals = with_rows(signals, places, held=held)
            sample_time = nearest_clock(seconds, places)[0]
        else:
            sample_time = uniform_step(seconds, time, start, lost=places is not None)
    found = Experiment.of(name, sample_time=sample_time, **signals, **conditions)  # pyright: ignore[reportArgumentType] - `of` checks them
    return mended(found) if mend else found


def _is_faulty(channel: str, values: Float64[np.ndarray, " sample"]) -> Bool[np.ndarray, " sample"]:
    return faulty(channel, values) if channel in OUTPUTS else np.zeros(len(values), dtype=bool)


def _unwrapped(values: Float64[np.ndarray, " sample"], beginning: float | None) -> Float64[np.ndarray, " sample"]:
    """Return an angle without jumps of whole turns, on the turn on which the arm is said to begin."""
    present = ~np.isnan(values)
    if not present.any():
        return values
    whole = values.copy()
    whole[present] = np.unwrap(values[present])
    turns = 0.0 if beginning is None else np.round((whole[present][0] - beginning) / (2 * np.pi))
    return whole - 2 * np.pi * turns


def _factor(channel: str, column: str, units: Mapping[str, str], scale: Mapping[str, float]) -> float:
    target = "s" if channel == "time" else UNITS[channel]
    if channel in scale:
        # A negative factor turns the direction round, which is a matter of how the sensor is mounted.
        factor = finite(f"scale/{channel}", scale[channel], "the factor")
        positive(f"scale/{channel}", abs(factor), "the size of the factor")
        return factor
    said = units.get(channel)
    unit = name_and_unit(column)[1] or ending_unit(column, target) or target if said is None else said
    if usual_spelling(unit) in FACTORS[target]:
        return FACTORS[target][usual_spelling(unit)]
    where, mend = f"units/{channel}", f"give scale={{{channel!r}: {target} per {unit}}} instead"
    if channel == "time":
        mend = "give sample_time instead"
    if said is None:
        where = f"column {column!r}"
        mend += f", or units={{{channel!r}: {target!r}}} if that is what the numbers are in"
    raise RecordingError(f"{where}: {unit!r} is not known for {channel}, only {', '.join(FACTORS[target])}; {mend}.")
