"""The values of a quantity by condition in words: whether it changed once, and where."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

_ALL_OF_IT = 0.95  # fraction of the scatter that one step must explain to be told; of values along a line it explains 0.75 to 0.8
_LEAST = 4  # values of which two on either side of a step may be alike
_SHOWN = 8  # values that are told one by one


def step_in_words(
    conditions: Sequence[str], values: Float[np.ndarray, " condition"], std: Float[np.ndarray, " condition"]
) -> str:
    """Say where a quantity changed once, in the order in which conditions were recorded; nothing where it did not.

    A trend is none: of values along a line one step explains three to four fifths.

    Args:
        conditions: their names.
        values: of the quantity in each; NaN where one shows nothing of it.
        std: of these values.
    """
    names, each, weights = _shown(conditions, values, std)
    if len(names) < _LEAST:
        return ""
    left = [_scatter(each[:k], weights[:k]) + _scatter(each[k:], weights[k:]) for k in range(1, len(names))]
    k = int(np.argmin(left)) + 1
    if not (1 < k < len(names) - 1 and left[k - 1] <= (1 - _ALL_OF_IT) * _scatter(each, weights)):
        return ""
    before, after = (np.average(part, weights=w) for part, w in ((each[:k], weights[:k]), (each[k:], weights[k:])))
    return f"changes once, from {before:.4g} up to {names[k - 1]} to {after:.4g} from {names[k]} on"


def values_in_words(
    conditions: Sequence[str], values: Float[np.ndarray, " condition"], std: Float[np.ndarray, " condition"]
) -> str:
    """Say which values a quantity takes that goes with nothing that was looked at; the arguments are those of `step_in_words`."""
    names, each, _ = _shown(conditions, values, std)
    if len(names) < 2:
        return ""
    if len(names) > _SHOWN:
        low, high = int(np.argmin(each)), int(np.argmax(each))
        span = f"from {each[low]:.4g} in {names[low]} to {each[high]:.4g} in {names[high]}"
        return f"scatters, {span}, with nothing that was looked at"
    listed = ", ".join(f"{value:.4g} in {name}" for name, value in zip(names, each, strict=True))
    return f"scatters, with nothing that was looked at: {listed}"


def _shown(
    conditions: Sequence[str], values: Float[np.ndarray, " condition"], std: Float[np.ndarray, " condition"]
) -> tuple[list[str], Float[np.ndarray, " known"], Float[np.ndarray, " known"]]:
    """Return the names, values and weights of the conditions that show something of a quantity."""
    known = np.isfinite(values) & np.isfinite(std) & (std > 0)
    return [name for name, one in zip(conditions, known, strict=True) if one], values[known], std[known] ** -2.0


def _scatter(values: Float[np.ndarray, " condition"], weights: Float[np.ndarray, " condition"]) -> float:
    """Return the weighted sum of squares about the mean."""
    return float(np.sum(weights * (values - np.average(values, weights=weights)) ** 2))
