"""Motor currents [A] for forced experiments."""

import math
from collections.abc import Sequence

import numpy as np
import scipy.signal
from jaxtyping import Float64


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
) -> Float64[np.ndarray, " sample"]:
    """A sum of equally large cosines with root mean square `rms` [A] over a period.

    The frequencies are `harmonics` of 1 / (period * sample_time), or all of these within `band` [Hz].
    `period` is in samples, and is all of them where it is not given. With a `seed` the phases are random;
    without, they are Schroeder's, which keep the peak low. Raises `ValueError` naming the option that is
    wrong.
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
    if seed is None:
        order = np.arange(len(chosen))
        phases = -np.pi * order * (order + 1) / len(chosen)
    else:
        phases = np.random.default_rng(seed).uniform(0, 2 * np.pi, len(chosen))
    spectrum = np.zeros(period // 2 + 1, dtype=np.complex128)
    spectrum[chosen] = np.exp(1j * phases)
    wave = np.fft.irfft(spectrum, period)
    return np.resize(wave * (rms / np.sqrt(np.mean(wave**2))), samples)


def square_wave(
    *, samples: int, sample_time: float, amplitude: float, frequency: float
) -> Float64[np.ndarray, " sample"]:
    """+amplitude and -amplitude [A] in turn at `frequency` [Hz].

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
    """A sine of `amplitude` [A] whose frequency runs linearly through `band` [Hz].

    Raises `ValueError` naming the option that is wrong.
    """
    _check(samples, sample_time=sample_time, amplitude=amplitude)
    for edge in band:
        _check_frequency("band", edge, sample_time)
    time = np.arange(samples) * sample_time
    # A sine, so that the current starts from zero.
    return amplitude * scipy.signal.chirp(time, band[0], samples * sample_time, band[1], phi=-90)


def prbs(*, samples: int, hold: int, amplitude: float, seed: int) -> Float64[np.ndarray, " sample"]:
    """A pseudo-random binary sequence of +-amplitude [A] that may change every `hold` samples.

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
