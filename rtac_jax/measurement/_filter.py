"""Smoothing and differentiation without delay, as in section 4.2 of the paper."""

import math

import numpy as np
import scipy.signal
from jaxtyping import Float64


def _checked(values: Float64[np.ndarray, " sample"], sample_time: float) -> Float64[np.ndarray, " sample"]:
    signal = np.asarray(values, dtype=np.float64)
    if signal.ndim != 1:
        raise ValueError(
            f"values: the shape is {signal.shape}, but one axis was expected; filter one channel at a time."
        )
    bad = ~np.isfinite(signal)
    if bad.any():
        index = int(np.argmax(bad))
        raise ValueError(f"values, sample {index}: is {signal[index]}; fill or cut missing samples before filtering.")
    if not (math.isfinite(sample_time) and sample_time > 0):
        raise ValueError(f"sample_time: is {sample_time}; give the positive number of seconds between samples.")
    return signal


def zero_phase_lowpass(
    values: Float64[np.ndarray, " sample"],
    *,
    sample_time: float,
    cutoff: float,
    order: int = 9,
    ripple_db: float = 0.05,
) -> Float64[np.ndarray, " sample"]:
    """Return `values` below `cutoff` [Hz], without delay: a Chebyshev filter of type I run forwards and backwards.

    `sample_time` is in seconds; the pass band ripples by `ripple_db` in each direction. The result has the
    shape of `values`. Raises `ValueError` for a cutoff at or above half the sampling rate, NaN, or too few
    samples.
    """
    signal = _checked(values, sample_time)
    nyquist = 0.5 / sample_time
    if not 0 < cutoff < nyquist:
        raise ValueError(
            f"cutoff: is {cutoff:g} Hz, but must lie between 0 and half the sampling rate, {nyquist:g} Hz; lower it."
        )
    if order < 1 or ripple_db <= 0:
        raise ValueError(f"order, ripple_db: are {order} and {ripple_db:g}; order is 1 or more, ripple_db positive.")
    # Second-order sections: as one fraction, nine poles close to 1 lose all digits.
    sections = scipy.signal.cheby1(order, ripple_db, 2 * cutoff * sample_time, output="sos")
    padding = 3 * (order + 1)
    if len(signal) <= padding:
        raise ValueError(
            f"values: has {len(signal)} samples, but this filter needs more than {padding}; record for longer."
        )
    # The filter rings for several periods of the cutoff, and must be done before the first sample.
    padding = min(len(signal) - 1, max(padding, math.ceil(4 / (cutoff * sample_time))))
    return scipy.signal.sosfiltfilt(sections, signal, padlen=padding)


def central_difference(
    values: Float64[np.ndarray, " sample"], *, sample_time: float
) -> Float64[np.ndarray, " sample-2"]:
    """Return the derivative [unit/s] of `values` at interior samples, (x[n+1] - x[n-1]) / (2 sample_time).

    The result has N - 2 samples, so its first belongs to sample 1. Raises `ValueError` for NaN or fewer than
    3 samples.
    """
    signal = _checked(values, sample_time)
    if len(signal) < 3:
        raise ValueError(f"values: has {len(signal)} samples, but a central difference needs 3; record for longer.")
    return (signal[2:] - signal[:-2]) / (2 * sample_time)


def filled(values: Float64[np.ndarray, " sample"]) -> Float64[np.ndarray, " sample"]:
    """Return the signal with its gaps bridged by straight lines."""
    bad = ~np.isfinite(values)
    if not bad.any():
        return values
    index = np.arange(len(values))
    return np.interp(index, index[~bad], values[~bad])
