"""A velocity that is read though the arm stands still: the sensor's zero."""

import numpy as np

from ._momentary_faults import resolution
from ._signal import Signal

_BLOCKS = 10  # whose means are independent where noise is coloured, too
_SIGMAS = 6.0  # of ten blocks of noise, a mean is as far off in 2 of 10,000 records


def read_at_rest(signal: Signal) -> str | None:
    """Return what a velocity at rest is beside its scatter; None where that is zero, or less than the sensor resolves.

    The standard deviation of the mean is that of the means of ten blocks, so that colour of the noise counts.
    """
    values = signal.values[~np.isnan(signal.values)]
    if len(values) < 10 * _BLOCKS:
        return None
    blocks = np.array([np.mean(block) for block in np.array_split(values, _BLOCKS)])
    mean, std = float(np.mean(blocks)), float(np.std(blocks, ddof=1) / np.sqrt(_BLOCKS))
    if abs(mean) <= max(_SIGMAS * std, resolution(values)):
        return None
    return f"{mean:.3g} +- {std:.1g} {signal.unit}"
