"""The clock of a recording: the distance of its samples as the times of a file tell it, and samples brought to another clock."""

from collections.abc import Collection, Mapping

import numpy as np
from jaxtyping import Bool, Float64

from ._errors import RecordingError
from ._signal import INPUTS, positive

Values = Float64[np.ndarray, " sample"]

UNIFORM = 1e-6
# Of a step, by which times that a logger rounds may be off the clock that they tell: microseconds of steps from a millisecond on.
ROUNDED = 2e-3
_TICK = 0.6  # of what times are rounded to, half of which rounding takes them off
_TICKS = 10.0 ** -np.arange(1, 7)  # to which a logger may round times [s]
_FINE = 0.25  # of a step: what rounds times more coarsely may hide a row that is missing
_WHOLE = 0.01  # of what times are rounded to, by which single precision may take them off
_COARSER = 1.5  # times, by which samples that are brought to another clock may be closer or farther apart than rows are
_GAP = 2.5  # of the usual step, from which on nothing is known between two samples


def uniform_step(times: Values, column: str, offset: int, *, lost: bool = False) -> float:
    """Return the common distance of `times` [s].

    Args:
        times: of all rows.
        column: their name.
        offset: index of the first.
        lost: whether rows that are missing explain why they are not uniform.

    Raises:
        RecordingError: the times are not uniform; names the index (plus `offset`) that is farthest off.
    """
    steps = _rising(times, column, offset)
    # The median is not moved by a gap, so the index found is that of the gap.
    typical = float(np.median(steps))
    off = np.abs(steps - typical)
    uneven = off > max(UNIFORM * typical, 0.5 * float(np.max(off)))
    mean = float((times[-1] - times[0]) / len(steps))
    if not uneven.any():
        return mean
    step, farthest = nearest_clock(times, np.arange(len(times)))
    if farthest > max(ROUNDED * mean, rounding(times, mean)):
        index = int(np.argmax(uneven))
        mend = (
            "bring the samples to one clock (resample=, --resample of rtac import), cut at the gap, or give sample_time if the"
            " times are only rounded"
        )
        if lost:
            mend = (
                "rows are missing there: put them back as missing samples (mend=True, --mend of rtac import), cut at the gap, or"
                " give sample_time if the times are only rounded"
            )
        raise RecordingError(
            f"{column}, index {index + 1 + offset}: the step is {steps[index]:.9g} s and elsewhere "
            f"{typical:.9g} s; {mend}."
        )
    return step


def nearest_clock(times: Values, places: np.ndarray) -> tuple[float, float]:
    """Return the step of the uniform clock that is nearest to the times of rows at some places, and how far they are off it [s]."""
    step, first = np.polynomial.polynomial.polyfit(places, times - times[0], 1)[::-1]
    return float(step), float(np.max(np.abs(times - times[0] - first - step * places)))


def rounding(times: Values, step: float) -> float:
    """Return how far a logger that rounds times to few decimals takes them off their clock [s]; zero where it does not.

    Args:
        times: as they stand in its file.
        step: of their clock [s]; what is rounded as coarsely may as well be rows that are missing.
    """
    for tick in _TICKS[_FINE * step >= _TICKS]:
        whole = times / tick
        if np.all(np.abs(whole - np.round(whole)) < _WHOLE):
            return float(_TICK * tick)
    return 0.0


def resampled(
    signals: Mapping[str, Values], times: Values, step: float, column: str, *, held: Collection[str]
) -> dict[str, Values]:
    """Return channels at samples a step apart: straight from row to row, missing in gaps; inputs that are held stay as they are.

    Of those a sample takes what holds in the middle of its interval. What holds at its beginning would be the row before wherever a
    row is stamped a little later than the first, and late by a whole sample.

    Args:
        signals: by channel, at the times of the rows.
        times: [s].
        step: [s].
        column: name of the times.
        held: inputs that stay what they are until the next row.

    Raises:
        RecordingError: the times do not increase, or the step is much longer or shorter than theirs.
    """
    step = positive("resample", step, "the seconds between samples")
    typical = float(np.median(_rising(times, column, 0)))
    if not typical / _COARSER <= step <= _COARSER * typical:
        lost = "what is faster is lost" if step > typical else "the noise of each row is counted several times"
        raise RecordingError(
            f"resample: is {step:.4g} s, and the rows are {typical:.4g} s apart; give about as much, or {lost}."
        )
    at = times[0] + step * np.arange(int((times[-1] - times[0]) / step * (1 + UNIFORM)) + 1)
    before = np.clip(np.searchsorted(times, at + UNIFORM * step, side="right") - 1, 0, len(times) - 1)
    after = np.minimum(before + 1, len(times) - 1)
    amid = np.clip(np.searchsorted(times, at + 0.5 * step, side="right") - 1, 0, len(times) - 1)
    unknown = (times[after] - times[before] > _GAP * typical) & (at - times[before] > UNIFORM * step)

    def of(channel: str, values: Values) -> Values:
        if channel in held:
            return values[amid]
        between = np.interp(at, times, values)  # beside a missing sample it is missing, too
        return between if channel in INPUTS else np.where(unknown, np.nan, between)

    return {channel: of(channel, values) for channel, values in signals.items()}


def _rising(times: Values, column: str, offset: int) -> Values:
    """Return the steps between times that increase.

    Raises:
        RecordingError: they do not.
    """
    steps = np.diff(times)
    bad = ~(steps > 0)
    if not len(steps) or bad.any():
        index = int(np.argmax(bad)) + 1 + offset if len(steps) else offset
        mend = "sort or cut the rows there"
        if len(steps) and steps[index - 1 - offset] == 0:
            mend = (
                "rows that say the same twice are dropped by mend=True (--mend of rtac import); cut or correct others"
            )
        raise RecordingError(f"{column}, index {index}: the time does not increase; {mend}.")
    return steps


def said_twice(times: Values, signals: Mapping[str, Values]) -> Bool[np.ndarray, " sample"]:
    """Return True at rows that say the same as the row before, time and all, as of a logger that wrote them twice."""
    again = np.diff(times, prepend=np.nan) == 0
    for values in signals.values():
        change = np.diff(values, prepend=np.nan)
        again &= (change == 0) | (np.isnan(values) & np.isnan(np.roll(values, 1)))
    return again
