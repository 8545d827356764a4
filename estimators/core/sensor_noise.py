"""Sensor noise levels: seen at rest, stated in the file, or read off the quietest part of the spectrum."""

from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import CubicSpline
from scipy.signal import welch

from rtac_jax.measurement import OUTPUTS, Experiment, filled

Values = Float[np.ndarray, " sample"]

# Noise over that of rounding alone, below which a channel has next to no other; steps a sample, below which it moves slowly.
_ROUNDING, _SLOW = 1.1, 1.5
_SOME = 0.02  # fraction of samples that are missing, up to which bridging them takes less than a fiftieth of the noise
_FEWEST = 16  # samples of which a spectrum is taken
_BRIDGED = 16  # samples that a gap may span and be bridged: a spline swings out over longer ones
_ENOUGH = 64  # samples of a part whose spectrum has a quiet band to be found
# Of a step, by which a multiple may be off; the fraction of differences that are multiples; the differences that are looked at.
_WHOLE, _NEARLY_ALL, _FEW_STEPS = 0.02, 0.95, 10.5
# Draws of white noise; the median of their ratios scatters by a twentieth where half of 300 samples are missing.
_WHITE_DRAWS = 9
# Draws whose median is what chance takes from the quietest band, and the samples from which on that is a fiftieth.
_QUIET_DRAWS, _MANY = 25, 20_000


def noise_levels(experiments: Sequence[Experiment]) -> dict[str, float]:
    """Return the standard deviation of the noise of every recorded channel, SI units.

    In this order: the standard deviation at rest; `noise_std` of the file; the quietest fifth of the spectrum, which is
    right where the motion leaves some band empty. Never below a twelfth of a quantisation step squared. A record that reads the
    same throughout tells neither noise nor step.
    """
    levels = {}
    for channel in OUTPUTS:
        holders = [e for e in experiments if channel in e.outputs]
        if not holders:
            continue
        step = _least_step(signal.values for e in holders if (signal := e.outputs[channel]).varies)
        stated = [s for e in holders if (s := e.outputs[channel].noise_std) is not None]
        resting = [signal.values for e in holders if e.kind == "rest" and (signal := e.outputs[channel]).varies]
        moving = [e for e in holders if e.kind != "rest" and e.outputs[channel].varies]
        if resting:
            deviations = np.concatenate([values - np.nanmean(values) for values in resting])
            level = float(np.sqrt(np.nanmean(deviations**2)))
        elif stated:
            level = float(np.sqrt(np.mean(np.square(stated))))
        elif not moving:
            level = 0.0
        else:
            level = float(np.median([spectral_floor(e.outputs[channel].values) for e in moving]))
        levels[channel] = max(level, step / np.sqrt(12.0), 1e-300)
    return levels


def stated_levels(experiments: Sequence[Experiment]) -> dict[tuple[str, str], float]:
    """Return the noise that the file states, by the names of experiment and channel, where no record at rest shows it, SI units.

    Never below a twelfth of a quantisation step squared.
    """
    resting = {
        channel for e in experiments if e.kind == "rest" for channel, signal in e.outputs.items() if signal.varies
    }
    return {
        (e.name, channel): max(signal.noise_std, quantisation_step(signal.values) / np.sqrt(12.0))
        for e in experiments
        for channel, signal in e.outputs.items()
        if channel not in resting and signal.noise_std is not None
    }


def rounded(experiments: Sequence[Experiment], levels: Mapping[str, float]) -> dict[str, float]:
    """Return the quantisation steps of channels that mostly move by less than one a sample, with no noise but rounding, SI units.

    Rounding is like random noise where a sensor passes several steps in a sample: Widrow and Kollar, Quantization Noise (2008),
    chapter 5.

    Args:
        experiments: that hold them.
        levels: noise of each channel, SI units.
    """
    found = {}
    for channel, step in only_rounding(experiments, levels).items():
        moves = [
            np.abs(np.diff(e.outputs[channel].values)) for e in experiments if channel in e.outputs and e.kind != "rest"
        ]
        if float(np.nanmedian(np.concatenate(moves))) < _SLOW * step:
            found[channel] = step
    return found


def only_rounding(experiments: Sequence[Experiment], levels: Mapping[str, float]) -> dict[str, float]:
    """Return the quantisation steps of channels that have next to no noise but rounding, SI units.

    Args:
        experiments: that hold them.
        levels: noise of each channel, SI units.
    """
    moving = [e for e in experiments if e.kind != "rest"]
    steps = {c: _least_step(e.outputs[c].values for e in moving if c in e.outputs) for c in levels}
    return {c: step for c, step in steps.items() if step > 0.0 and levels[c] < _ROUNDING * step / np.sqrt(12.0)}


def _least_step(several: Iterable[Values]) -> float:
    """Return the smallest quantisation step that any of several records shows; zero where another has values between."""
    records = list(several)
    least = min((step for values in records if (step := quantisation_step(values)) > 0.0), default=0.0)
    return (
        least if least and all(_is_multiple(np.diff(values[np.isfinite(values)]), least) for values in records) else 0.0
    )


def _is_multiple(differences: Values, step: float) -> bool:
    """Return whether nearly all differences of a few steps are whole multiples of it: a file rounds larger ones apart."""
    ratio = differences / step
    ratio = ratio[np.abs(ratio) < _FEW_STEPS]
    return bool(np.mean(np.abs(ratio - np.round(ratio)) < _WHOLE) > _NEARLY_ALL) if len(ratio) else True


def quantisation_step(values: Values) -> float:
    """Return the smallest difference between two recorded values.

    Zero unless most differences are whole multiples of it.
    """
    present = np.unique(values[np.isfinite(values)])
    steps = np.diff(present)
    steps = steps[steps > 1e-9 * max(np.max(np.abs(present), initial=0.0), 1e-300)]
    if len(steps) == 0 or len(present) > 0.5 * len(values):
        return 0.0
    step = float(np.min(steps))
    return step if _is_multiple(steps, step) else 0.0


def spectral_floor(values: Values) -> float:
    """Return the standard deviation of the white noise that would fill the quietest fifth of the spectrum.

    A channel read every nth sample is taken at its own rate. Where other samples are missing it is taken in parts between long
    gaps, with short ones bridged by cubic splines, which follow the motion. What that takes from the noise is what it takes from
    white noise with the same samples missing.
    """
    present = np.flatnonzero(np.isfinite(values))
    apart = np.unique(np.diff(present))
    if len(present) < 2 or len(present) > (1 - _SOME) * len(values):
        return _quietest(filled(values))
    if len(apart) == 1 and len(present) >= _FEWEST:
        return _quietest(values[present])
    return _quietest_in_parts(values) / _left_in_parts(np.isfinite(values).tobytes())


@lru_cache(maxsize=256)
def _left_in_parts(measured: bytes) -> float:
    """Return the fraction of white noise that is left where samples are missing; asked often, for the same."""
    mask = np.frombuffer(measured, dtype=bool)
    whole = np.random.default_rng(0).standard_normal((_WHITE_DRAWS, len(mask)))
    gapped = np.where(mask, whole, np.nan)
    left = [_quietest_in_parts(row) / _quietest(white) for row, white in zip(gapped, whole, strict=True)]
    return float(np.median(left))


def _quietest_in_parts(values: Values) -> float:
    """Return the rms of what is quietest in the parts between long gaps that are long enough, or in the longest."""
    present = np.flatnonzero(np.isfinite(values))
    parts = np.split(present, np.flatnonzero(np.diff(present) > _BRIDGED) + 1)
    used = [part for part in parts if len(part) >= _ENOUGH] or [max(parts, key=len)]
    if len(used[0]) < _FEWEST:
        return _quietest(filled(values))
    levels = [_quietest(_bridged(values, part)) for part in used]
    return float(np.sqrt(np.average(np.square(levels), weights=[len(part) for part in used])))


def _bridged(values: Values, present: Int[np.ndarray, " present"]) -> Float[np.ndarray, " part"]:
    """Return the signal from the first to the last of these samples, by a cubic spline through them."""
    every = np.arange(present[0], present[-1] + 1)
    return CubicSpline(present, values[present])(every) if 3 < len(present) < len(every) else filled(values[every])


def _quietest(values: Values) -> float:
    """Return the standard deviation of white noise as strong as the quietest fifth of the spectrum; no sample is missing."""
    return float(np.sqrt(np.min(_powers(values)))) / _of_white(_near(len(values)))


def _powers(values: Values) -> Float[np.ndarray, " band"]:
    """Return the variance of the white noise that would fill each fifth of the spectrum as it is filled."""
    length = int(min(len(values), max(64, len(values) // 16)))
    # A window of low side lobes, or a strong resonance would leak over the whole spectrum.
    frequency, density = welch(values, fs=1.0, window="blackmanharris", nperseg=length, detrend="linear")
    width = max(3, len(frequency) // 5)
    bands = np.lib.stride_tricks.sliding_window_view(density[1:-1], min(width, len(density) - 2))
    return 0.5 * np.mean(bands, axis=1)


def _near(count: int) -> int:
    """Return a number of samples with two digits that count, so that few are asked for, and none of more than are told apart."""
    size = 10 ** max(len(str(count)) - 2, 0)
    return min(round(count / size) * size, _MANY)


@lru_cache(maxsize=256)
def _of_white(count: int) -> float:
    """Return the rms of what is quietest in white noise of so many samples, in the upper half of its spectrum, over its own.

    The least of several bands is below their mean by chance: by an eighth of 600 samples. Motion fills the lower half.
    """
    random = np.random.default_rng(0)
    powers = [_powers(random.standard_normal(count)) for _ in range(_QUIET_DRAWS)]
    return float(np.median([np.sqrt(np.min(each[len(each) // 2 :])) for each in powers]))
