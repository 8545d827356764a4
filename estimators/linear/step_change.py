"""The values of a quantity by condition in words: whether it changed once, and where."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

_ALL_OF_IT = 0.95  # fraction of the scatter that one step must explain to be told
_SHOWN = 8  # values that are told one by one


def values_in_words(
    conditions: Sequence[str], values: Float[np.ndarray, " condition"], std: Float[np.ndarray, " condition"]
) -> str:
    """Say how a quantity differs between conditions, in the order in which they were recorded.

    Args:
        conditions: their names.
        values: of the quantity in each; NaN where one shows nothing of it.
        std: of these values.
    """
    shown = np.isfinite(values) & np.isfinite(std) & (std > 0)
    names = [name for name, known in zip(conditions, shown, strict=True) if known]
    each, weights = values[shown], std[shown] ** -2.0
    if len(names) < 2:
        return ""
    left = [_scatter(each[:k], weights[:k]) + _scatter(each[k:], weights[k:]) for k in range(1, len(names))]
    k = int(np.argmin(left)) + 1
    if 1 < k < len(names) - 1 and left[k - 1] <= (1 - _ALL_OF_IT) * _scatter(each, weights):
        before, after = (np.average(part, weights=w) for part, w in ((each[:k], weights[:k]), (each[k:], weights[k:])))
        return f"changes once, from {before:.4g} up to {names[k - 1]} to {after:.4g} from {names[k]} on"
    if len(names) > _SHOWN:
        low, high = int(np.argmin(each)), int(np.argmax(each))
        span = f"from {each[low]:.4g} in {names[low]} to {each[high]:.4g} in {names[high]}"
        return f"scatters, {span}, with nothing that was looked at"
    listed = ", ".join(f"{value:.4g} in {name}" for name, value in zip(names, each, strict=True))
    return f"scatters, with nothing that was looked at: {listed}"


def _scatter(values: Float[np.ndarray, " condition"], weights: Float[np.ndarray, " condition"]) -> float:
    """Return the weighted sum of squares about the mean."""
    return float(np.sum(weights * (values - np.average(values, weights=weights)) ** 2))
