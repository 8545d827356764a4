"""Motor currents [A] for forced experiments."""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
import scipy.signal
from jaxtyping import Float64, Int64

_CLIP = (0.80, 0.995)  # of the peak, from the first iteration to the last


def _check(samples: int, **positive: float) -> None:
    if samples < 1:
        raise ValueError(f"samples: is {samples}; ask for at least one.")
    for name, value in positive.items():
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{name}: is {value}; give a positive number.")


def _check_frequency(name: str, frequency: float, sample_time: float) -> None:
    if not 0 < frequency < 0.5 / sample_time:
        raise ValueError(
            f"{name}: {frequency:g} Hz must lie between 0 and half the sampling rate, {0.5 / sample_time:g} "
            "Hz; change it."
        )


def multisine(
    *,
    samples: int,
    sample_time: float,
    rms: float,
    harmonics: Sequence[int] | None = None,
    band: tuple[float, float] | None = None,
    seed: int | None = None,
    period: int | None = None,
    amplitudes: Sequence[float] | Float64[np.ndarray, " harmonic"] | None = None,
    crest_iterations: int = 0,
) -> Float64[np.ndarray, " sample"]:
    """Return a sum of cosines with root mean square `rms` [A] over a period, shape [samples].

    The frequencies are `harmonics` of 1 / (period * sample_time), or all of these within `band` [Hz].
    `period` is in samples, and is all of them where it is not given. The cosines are equally large, or in the
    ratio of `amplitudes`, one for each harmonic in rising order: 1 / |G| makes the output of G equally rich.
    With a `seed` the phases are random; without, they are Schroeder's, which keep the peak low.
    `crest_iterations` of clipping the wave and restoring its amplitudes lower the peak further (van der
    Ouderaa, Schoukens and Renneboog 1988). Raises `ValueError` naming the option that is wrong.
    """
    period = samples if period is None else period
    _check(samples, sample_time=sample_time, rms=rms, period=period)
    if (harmonics is None) == (band is None):
        raise ValueError("harmonics, band: give one of the two.")
    if band is not None:
        _check_frequency("band", band[1], sample_time)
        # Rounding must not drop a harmonic that lies on the edge.
        low, high = (edge * period * sample_time for edge in band)
        harmonics = range(max(1, math.ceil(low - 1e-9)), math.floor(high + 1e-9) + 1)
    chosen = np.unique(np.asarray(harmonics, dtype=np.int64))
    highest = (period - 1) // 2
    if not len(chosen) or chosen[0] < 1 or chosen[-1] > highest:
        raise ValueError(
            f"harmonics: {chosen.tolist()} must be numbers from 1 to {highest}, at least one; lengthen the period."
        )
    sizes = np.ones(len(chosen)) if amplitudes is None else np.asarray(amplitudes, dtype=np.float64)
    if sizes.shape != chosen.shape or not np.all(np.isfinite(sizes)) or np.any(sizes < 0) or not sizes.any():
        raise ValueError(
            f"amplitudes: give {len(chosen)} finite numbers, none negative and not all zero, one for each harmonic."
        )
    if crest_iterations < 0:
        raise ValueError(f"crest_iterations: is {crest_iterations}; give a number of iterations, or 0 for none.")
    if seed is None:
        # Schroeder's rule for unequal amplitudes; for equal ones it is -pi n (n + 1) / N.
        fraction = np.cumsum(sizes**2) / np.sum(sizes**2)
        order = np.arange(len(chosen))
        phases = -np.pi * order * (order + 1) / len(chosen) if amplitudes is None else -2 * np.pi * np.cumsum(fraction)
    else:
        phases = np.random.default_rng(seed).uniform(0, 2 * np.pi, len(chosen))
    wave = _wave(chosen, sizes, phases, period)
    best = wave
    for ratio in np.linspace(*_CLIP, crest_iterations):
        peak = np.max(np.abs(wave))
        phases = np.angle(np.fft.rfft(np.clip(wave, -ratio * peak, ratio * peak))[chosen])
        wave = _wave(chosen, sizes, phases, period)
        if crest_factor(wave) < crest_factor(best):
            best = wave
    return np.resize(best * (rms / np.sqrt(np.mean(best**2))), samples)


def _wave(harmonics: np.ndarray, sizes: np.ndarray, phases: np.ndarray, period: int) -> np.ndarray:
    spectrum = np.zeros(period // 2 + 1, dtype=np.complex128)
    spectrum[harmonics] = sizes * np.exp(1j * phases)
    return np.fft.irfft(spectrum, period)


def crest_factor(wave: Float64[np.ndarray, " sample"]) -> float:
    """Return the peak over the root mean square [1]: 1 for a square wave, 1.414 for a sine.

    Raises:
        ValueError: the wave is zero throughout.
    """
    if not np.any(wave):
        raise ValueError("wave: is zero throughout, so it has no crest factor.")
    return float(np.max(np.abs(wave)) / np.sqrt(np.mean(np.square(wave))))


def harmonic_grid(
    kind: Literal["all", "odd", "random_odd"],
    *,
    period: int,
    sample_time: float,
    band: tuple[float, float],
    seed: int = 0,
    group: int = 4,
) -> Int64[np.ndarray, " harmonic"]:
    """Return the harmonics of 1 / (period * sample_time) within `band` [Hz] that a multisine excites, as numbers.

    "all" of them, the "odd" ones, which leave the even ones to show even nonlinearities, or "random_odd": of every
    `group` odd ones in a row, one by chance is left out and shows odd nonlinearities (Pintelon and Schoukens 2012,
    section 4.3). `period` is in samples. Raises `ValueError` naming the option that is wrong.
    """
    _check(period, sample_time=sample_time)
    if kind not in ("all", "odd", "random_odd"):
        raise ValueError(f"kind: is {kind!r}; use 'all', 'odd' or 'random_odd'.")
    if group < 2:
        raise ValueError(f"group: is {group}; leave one harmonic out of at least two.")
    _check_frequency("band", band[1], sample_time)
    low, high = (edge * period * sample_time for edge in band)
    numbers = np.arange(max(1, math.ceil(low - 1e-9)), math.floor(high + 1e-9) + 1)
    if kind != "all":
        numbers = numbers[numbers % 2 == 1]
    if kind == "random_odd":
        starts = np.arange(0, len(numbers) - group + 1, group)
        numbers = np.delete(numbers, starts + np.random.default_rng(seed).integers(group, size=len(starts)))
    if not len(numbers):
        raise ValueError(f"band: no {kind} harmonic lies within {band[0]:g} to {band[1]:g} Hz; lengthen the period.")
    return numbers


def positive_negative(wave: Float64[np.ndarray, " sample"]) -> Float64[np.ndarray, " two_samples"]:
    """Return `wave` and then its negative, so that what pushes one way pushes the other as well (paper, section 5.2).

    As a period of its own the pair has odd harmonics only.
    """
    return np.concatenate([wave, -wave])


def from_rest(wave: Float64[np.ndarray, " sample"]) -> Float64[np.ndarray, " sample"]:
    """Return one period of a wave without mean, begun where its running sum passes its own mean.

    A free body that such a torque drives from rest swings about where it stood; begun elsewhere, it would drift away
    with the velocity that the periodic motion has there. Raises `ValueError` for a wave with a mean.
    """
    if abs(np.mean(wave)) > 1e-6 * np.max(np.abs(wave)):
        raise ValueError("wave: has a mean, under which a free body drifts wherever it begins; take the mean off.")
    # The velocity at each sample; over an interval, in which the wave is held, its mean lies half a step further.
    speed = np.concatenate([[0.0], np.cumsum(wave)[:-1]])
    return np.roll(wave, -int(np.argmin(np.abs(speed - np.mean(speed + 0.5 * wave)))))


def steps(*, samples: int, hold: int, levels: Sequence[float]) -> Float64[np.ndarray, " sample"]:
    """Return each of `levels` [A] in turn for `hold` samples, again from the first where they end, shape [samples].

    Raises `ValueError` naming the option that is wrong.
    """
    _check(samples, hold=hold)
    values = np.asarray(levels, dtype=np.float64)
    if values.ndim != 1 or not len(values) or not np.all(np.isfinite(values)):
        raise ValueError("levels: give a list of finite currents, at least one.")
    return np.resize(np.repeat(values, hold), samples)


def square_wave(
    *, samples: int, sample_time: float, amplitude: float, frequency: float
) -> Float64[np.ndarray, " sample"]:
    """Return +amplitude and -amplitude [A] in turn at `frequency` [Hz], shape [samples].

    Raises `ValueError` naming the option that is wrong.
    """
    _check(samples, sample_time=sample_time, amplitude=amplitude)
    _check_frequency("frequency", frequency, sample_time)
    # An edge that falls on a sample belongs to it, whatever the rounding.
    half_periods = np.floor(2 * frequency * sample_time * np.arange(samples) + 1e-9)
    return amplitude * (1.0 - 2.0 * (half_periods % 2))


def chirp(
    *, samples: int, sample_time: float, amplitude: float, band: tuple[float, float]
) -> Float64[np.ndarray, " sample"]:
    """Return a sine of `amplitude` [A] whose frequency runs linearly through `band` [Hz], shape [samples].

    Raises `ValueError` naming the option that is wrong.
    """
    _check(samples, sample_time=sample_time, amplitude=amplitude)
    for edge in band:
        _check_frequency("band", edge, sample_time)
    time = np.arange(samples) * sample_time
    # A sine, so that the current starts from zero.
    return amplitude * scipy.signal.chirp(time, band[0], samples * sample_time, band[1], phi=-90)


def prbs(*, samples: int, hold: int, amplitude: float, seed: int) -> Float64[np.ndarray, " sample"]:
    """Return a pseudo-random binary sequence of +-amplitude [A] that may change every `hold` samples, shape [samples].

    It is the shortest maximum-length sequence that does not repeat within `samples`, started at a place
    chosen by `seed`. Raises `ValueError` naming the option that is wrong.
    """
    _check(samples, hold=hold, amplitude=amplitude)
    bits = math.ceil(samples / hold)
    register = max(2, bits.bit_length())
    sequence, _ = scipy.signal.max_len_seq(register)
    start = np.random.default_rng(seed).integers(len(sequence))
    chosen = np.roll(sequence, -start)[:bits]
    return amplitude * (2.0 * np.repeat(chosen, hold)[:samples] - 1.0)
