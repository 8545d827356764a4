"""Vuong's test of two models that need not contain each other, on sums over stretches of time."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int


def by_stretch(values: Float[np.ndarray, "..."], blocks: Int[np.ndarray, "..."]) -> Float[np.ndarray, " stretch"]:
    """Return the sums of values over stretches of time, those without a sample left out.

    Args:
        values: of every sample.
        blocks: number of the stretch that each sample belongs to.
    """
    sums = np.bincount(blocks.ravel(), weights=values.ravel())
    return sums[np.bincount(blocks.ravel()) > 0]


def vuong_statistic(better: Sequence[float], other: Sequence[float], price: float) -> float:
    """Return the standard normal statistic for the better of two models that need not contain each other.

    Args:
        better: log-likelihoods of the better model by stretch.
        other: the same of the other model.
        price: of the parameters that the better model has more, in log-likelihood.

    Source: Vuong, Econometrica 57 (1989), on sums over stretches of time.
    """
    gain = np.asarray(better) - np.asarray(other)
    scatter = float(np.std(gain, ddof=1)) * math.sqrt(len(gain)) if len(gain) > 1 else 0.0
    total = float(np.sum(gain)) - price
    if scatter > 0:
        return total / scatter
    return math.copysign(math.inf, total) if total else 0.0
