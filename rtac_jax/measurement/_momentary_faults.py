"""Faults of a channel that last for a moment: dropouts, the end of a range, lost samples, and spikes of several samples.

No model is needed.
"""

from collections.abc import Iterator

import numpy as np
import scipy.ndimage
from jaxtyping import Float64

from ._signal import Signal

Values = Float64[np.ndarray, " sample"]

# Expected number of alarms in a channel of pure chance.
CHANCE = 1e-6
# Equal values in a row that are looked at; fewer come about by chance in every quantised signal.
_SHORTEST_RUN = 5
# Times the usual step between neighbours (a standard deviation of Gaussian steps), as `OUTLIER_SIGMAS` of lone samples.
_SIGMAS = 10.0
_NEARBY = 51  # samples in which a step is usual
_WIDEST_SPIKE = 3  # samples
_SLOPE_SAMPLES = 13  # neighbouring steps whose median is the slope
MEDIAN_TO_STD = 1.4826
# Levels by which a slow signal that is quantised comes to a value and leaves it: a step of two is no jump.
_SLOWED = (
    0.25  # of the rms step, below which the steps before a position stays as it is are those of what comes to rest
)
_RESTING = 0.2  # of all steps, that are exactly zero where a signal is one of counts
_QUIET_LEVELS = 2.5
_FEW_LEVELS = 10.0  # of a quantised signal, whose extremes are no end of a range
_MENDED = "make these samples missing (rtac import --mend, Recording.mended, or NaN)"


def momentary_faults(name: str, signal: Signal) -> Iterator[str]:
    """Yield a sentence for each kind of momentary fault of an output that moves.

    Args:
        name: of the channel. Only a position or an angle cannot jump; a velocity can, at an impact.
        signal: the channel.
    """
    present = np.flatnonzero(~np.isnan(signal.values))
    values = signal.values[present]
    if len(values) <= 2 * _SLOPE_SAMPLES or np.ptp(values) == 0:
        return
    runs = dropouts(name, values)
    inside = np.zeros(len(values), dtype=bool)
    for first, last in runs:
        inside[max(first - 2, 0) : last + 2] = True
    if runs:
        first, last = runs[0]
        what = "zero" if values[first] == 0 else "one and the same value"
        more = f", and {len(runs) - 1} times more" if len(runs) > 1 else ""
        yield (
            f"is exactly {what} for {last - first} samples from sample {present[first]} on{more}, as when the sensor "
            f"or the logger drops out; {_MENDED}."
        )
    if (ends := clipped(values)).any():
        where = " and ".join(f"{x:.4g}" for x in np.unique(values[ends]))
        yield (
            f"stays at exactly {where} {signal.unit} for {np.count_nonzero(ends)} samples, as where the range of the sensor ends;"
            f" {_MENDED}, and widen the range."
        )
    steps = np.diff(values)
    excess, limit = _excess_of_steps(values, present, inside)
    spikes = _spikes(excess, limit, narrowest=2)
    if spikes:
        yield (
            f"has {len(spikes)} spikes of two or three samples, the first at sample {present[spikes[0][0]]}; {_MENDED}, "
            "or fit with robust=True; keep them where parts of the rig hit each other then."
        )
    if name == "arm_velocity":
        return
    jumps = _jumps(steps, excess, limit)
    if len(jumps):
        place = jumps[np.argmax(np.abs(excess[jumps]))]
        size = abs(float(excess[place]))
        more = f" ({len(jumps)} such places)" if len(jumps) > 1 else ""
        turn = {"arm_angle": 2 * np.pi}.get(name, np.inf)
        if abs(size - turn) < 0.05 * turn:
            yield (
                f"jumps by a whole turn at sample {present[place] + 1}{more}, as if wrapped; unwrap it (rtac import --unwrap, or "
                "numpy.unwrap)."
            )
        else:
            yield (
                f"jumps by {size:.3g} {signal.unit} at sample {present[place] + 1}{more}, which nothing that has mass can, so "
                "samples were lost there; cut the experiment in two (Experiment.cut)."
            )


def faulty(name: str, values: Values) -> np.ndarray:
    """Return whether each sample of an output that moves is clipped, dropped out, or part of a spike that no motion is.

    Args:
        name: of the channel; a spike of a velocity may be an impact.
        values: of the channel, which may have gaps.
    """
    present = np.flatnonzero(~np.isnan(values))
    found = np.zeros(len(values), dtype=bool)
    known = values[present]
    if len(known) <= 2 * _SLOPE_SAMPLES or np.ptp(known) == 0:
        return found
    found[present] = clipped(known)
    for first, last in dropouts(name, known):
        found[present[first:last]] = True
    if name != "arm_velocity":
        found[spikes(values)] = True
    return found


def clipped(values: Values) -> np.ndarray:
    """Return whether each sample is at an extreme at which the values stay again and again, as at the end of a sensor's range.

    They come to the end of a range and leave it as fast as they move beside it. A cart that comes to rest there slows down.
    """
    found = np.zeros(len(values), dtype=bool)
    level = resolution(values)
    if np.ptp(values) < _FEW_LEVELS * level:
        return found
    steps = np.abs(np.diff(values))
    slow = max(_QUIET_LEVELS * level, _SIGMAS / 2 * float(np.median(_scatter_of_steps(values, np.diff(values)))))
    for extreme in (values.max(), values.min()):
        here = values == extreme
        edges = np.flatnonzero(np.diff(np.concatenate(([False], here, [False])).astype(np.int8)))
        # The last step to it may be cut short by the end, so that the one before tells, and so after it.
        fast = [
            first >= 2 and last + 1 < len(values) and min(steps[first - 2], steps[last]) > slow
            for first, last in zip(edges[::2], edges[1::2], strict=True)
        ]
        runs = (edges[1::2] - edges[::2])[fast]
        # Held once before release is no clipping, and a quantised peak also fills the level below.
        distinct = values[~here]
        following = np.count_nonzero(values == (distinct.max() if extreme == values.max() else distinct.min()))
        if np.count_nonzero(runs >= 3) >= 2 and runs.sum() > 0.01 * len(values) and runs.sum() > 5 * following:
            found |= here
    return found


def resolution(values: Values) -> float:
    """Return the step of a quantised signal [its unit]; zero where the steps between neighbours are no multiples of the least."""
    steps = np.abs(np.diff(values))
    steps = steps[steps > 1e-9 * np.ptp(values)]
    if not len(steps):
        return 0.0
    least = float(np.min(steps))
    few = steps[steps < 10.5 * least]  # a file with few digits rounds each of them
    level = float(np.sum(few) / np.sum(np.round(few / least)))
    multiples = steps / level
    return level if np.mean(np.abs(multiples - np.round(multiples)) < 0.1) > 0.95 else 0.0


def spikes(values: Values) -> np.ndarray:
    """Return the samples of spikes of one to three samples in a channel, which may have gaps."""
    present = np.flatnonzero(~np.isnan(values))
    known = values[present]
    if len(known) <= 2 * _SLOPE_SAMPLES or np.ptp(known) == 0:
        return np.zeros(0, dtype=np.int64)
    found = _spikes(*_excess_of_steps(known, present, np.zeros(len(known), dtype=bool)), narrowest=1)
    return present[sorted({first + more for first, width in found for more in range(width)})]


def _excess_of_steps(values: Values, present: np.ndarray, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return by how much each step differs from those about it, and from which size on that is a fault.

    Args:
        values: that were measured.
        present: their places.
        inside: whether a value is part of a dropout.
    """
    steps = np.diff(values)
    # Across a gap a step may be large.
    usable = (np.diff(present) == 1) & ~inside[:-1] & ~inside[1:]
    excess = np.where(usable, steps - scipy.ndimage.median_filter(steps, _SLOPE_SAMPLES, mode="reflect"), 0.0)
    limit = _SIGMAS * _scatter_of_steps(values, steps)
    if np.mean(steps == 0) > _RESTING and not resolution(values):
        # Counts of an encoder that were brought to another clock: what lies between two of them is no step of its own.
        limit = np.maximum(limit, _QUIET_LEVELS * float(np.median(np.abs(steps[steps != 0]))))
    return excess, limit


def dropouts(name: str, values: Values) -> list[tuple[int, int]]:
    """Return first and past-the-last index of runs of one value that are too long for chance.

    A cart that has stopped shows one value too where the noise is below the resolution, and so does a slow arm between two lines
    of its encoder; they neither come to it nor leave it by a jump. Where the sensor flickers, one value is a fault whatever comes
    next. A velocity that is exactly zero from the beginning is no fault, nor one that slows down to zero at the end: so reads what
    is computed from an encoder while nothing moves.

    Args:
        name: of the channel.
        values: without gaps.
    """
    equal = np.concatenate([[False], np.diff(values) == 0, [False]]).astype(np.int8)
    edges = np.flatnonzero(np.diff(equal))
    firsts, lasts = edges[::2], edges[1::2] + 1
    lengths = lasts - firsts
    long = lengths >= _SHORTEST_RUN
    if not long.any():
        return []
    usual = float(np.sum(lengths[~long] - 1) + 1) / max(len(values) - float(np.sum(lengths[long])), 1.0)
    usual = min(usual, 1.0 - 1e-9)
    still = _unchanged_by_noise(values)
    logarithm = np.log(CHANCE / len(values))
    needed, certain = (1 + logarithm / np.log(min(max(usual, p), 1 - 1e-9)) for p in (usual, still))
    quiet = _QUIET_LEVELS * resolution(values)
    moving = np.abs(np.diff(values))
    usual_speed = float(np.median(moving[moving > 0]))
    if np.mean(moving == 0) > _RESTING:  # counts, whose steps were divided where samples were taken between others
        quiet = max(quiet, 2.0 * usual_speed)
    found = []
    for first, last in zip(firsts[long], lasts[long], strict=True):
        if last - first < needed or last - first == len(values):
            continue
        # A dropout is come to or left by a jump beside the steps on that side: a cart that friction lets go makes larger ones soon.
        before, after = values[max(first - _NEARBY // 2, 0) : first], values[last : last + _NEARBY // 2]
        sides = ((values[first] - before[-1:], before), (after[:1] - values[first], after))
        jumps = [bool(np.any(np.abs(jump) > max(0.5 * _SIGMAS * _usual_step(side), quiet))) for jump, side in sides]
        if name == "arm_velocity" and values[first] == 0 and (first == 0 or (last == len(values) and not jumps[0])):
            continue
        if name != "arm_velocity" and last == len(values) and _comes_to_rest(before, float(values[first]), usual_speed):
            continue
        if _rests(values[max(first - _SHORTEST_RUN, 0) : last + _SHORTEST_RUN], float(np.min(moving[moving > 0]))):
            continue
        if last - first >= certain or any(jumps):
            found.append((int(first), int(last)))
    return found


def _comes_to_rest(before: Values, last: float, usual: float) -> bool:
    """Return whether values move by little of the usual step, or by less than the counts of an encoder, and end without a jump."""
    steps = np.abs(np.diff(before))
    if not len(steps) or abs(last - before[-1]) > np.max(steps):
        return False
    return bool(np.mean(steps) < _SLOWED * usual or np.mean(steps == 0) > _RESTING)


def _rests(values: Values, least: float) -> bool:
    """Return whether what is about a run of one value changes by the least step alone, as what stands still does."""
    return bool(np.max(np.abs(np.diff(values))) < _QUIET_LEVELS * least)


def _usual_step(side: Values) -> float:
    """Return the standard deviation of Gaussian steps with the median of these; infinite where there are none."""
    return MEDIAN_TO_STD * float(np.median(np.abs(np.diff(side)))) if len(side) > 1 else np.inf


def _unchanged_by_noise(values: Values) -> float:
    """Return the probability that two neighbouring samples of a sensor at rest are equal; 1 where it shows no white noise."""
    third = np.diff(values, 3)
    power = float(np.sum(third**2))
    # Of white noise the third differences are correlated by -0.75, of a smooth motion by nearly 1.
    if power == 0 or float(np.sum(third[1:] * third[:-1])) / power > -0.5:
        return 1.0
    noise = MEDIAN_TO_STD * float(np.median(np.abs(third))) / np.sqrt(20)
    sizes = np.unique(np.abs(np.diff(values)))
    sizes = sizes[sizes > 1e-9 * np.ptp(values)]
    steps = np.abs(np.diff(values))
    # Of counts the least step may be a part of one, where samples were taken between others.
    level = float(np.median(steps[steps > 0])) if np.mean(steps == 0) > _RESTING else float(sizes[0])
    # The density of the difference of two samples at zero, times the width of a level.
    return min(float(sizes[0]) / (2 * np.sqrt(np.pi) * noise), 1.0) if noise > 0.5 * level else 1.0


def _scatter_of_steps(values: Values, steps: np.ndarray) -> np.ndarray:
    """Return the standard deviation of a step by noise: the larger of that nearby and that of the whole signal.

    It comes from third differences, which the motion hardly shows: of white noise they have the variance 20, steps 2.
    """
    third = np.abs(np.diff(values, 3, prepend=values[:1], append=values[-1:]))[: len(steps)]
    scale = MEDIAN_TO_STD * np.sqrt(2 / 20)
    nearby = scipy.ndimage.median_filter(third, _NEARBY, mode="reflect")
    # Of a signal that is quantised more coarsely than its noise the median may be zero, and a level is its smallest step.
    sizes = np.unique(np.abs(steps))
    level = (
        float(sizes[sizes > 1e-9 * np.ptp(values)][0])
        if np.mean(np.abs(steps) <= 1e-9 * np.ptp(values)) > 0.02
        else 0.0
    )
    # One that moves by nearly a whole number of levels a sample shows no noise, and now and then a level more.
    least = max(level, _QUIET_LEVELS / _SIGMAS * resolution(values), 1e-9 * np.ptp(values))
    return np.maximum(scale * np.maximum(nearby, np.median(third)), least)


def _spikes(excess: np.ndarray, limit: np.ndarray, *, narrowest: int) -> list[tuple[int, int]]:
    """Return first sample and width of spikes of up to three samples: a jump, nearly the same jump back, and little between."""
    found = []
    for first in np.flatnonzero(np.abs(excess) > limit):
        height = excess[first]
        for width in range(narrowest, _WIDEST_SPIKE + 1):
            if first + width >= len(excess):
                continue
            between = np.abs(excess[first + 1 : first + width])
            around = np.abs(
                np.concatenate([excess[max(first - 2, 0) : first], excess[first + width + 1 : first + width + 3]])
            )
            if abs(height + excess[first + width]) < 0.25 * abs(height) and np.all(
                np.concatenate([between, around]) < 0.25 * abs(height)
            ):
                found.append((int(first) + 1, width))
    return found


def _jumps(steps: np.ndarray, excess: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """Return the places of single steps far beyond their neighbours', which differ among each other by less than half of that.

    At an impact the steps before and after differ themselves, and about a spike there are two large ones.
    """
    found = []
    for place in np.flatnonzero(np.abs(excess) > limit):
        if 3 <= place < len(steps) - 3:
            around = np.concatenate([steps[place - 3 : place], steps[place + 1 : place + 4]])
            if abs(excess[place]) > 2 * np.ptp(around):
                found.append(place)
    return np.asarray(found, dtype=np.int64)
