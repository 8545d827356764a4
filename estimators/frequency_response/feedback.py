"""A test of whether the input follows the noise of the output, as a controller in the loop makes it."""

import numpy as np
import scipy.stats
from jaxtyping import Float64

Values = Float64[np.ndarray, " sample"]

_ORDER = 20  # samples of the past that predict the output: two modes and coloured noise
_AHEAD = 10  # samples within which a controller answers
_LONGEST = 20_000  # samples that are looked at
_CHANCE = 1e-4  # of what an input without feedback shows
_LITTLE = 0.05  # of what is new in the input; discs of 95 % still hold 93 % of the truth at 0.15
_DEPENDENT = 1e-7  # singular value, relative to the largest, below which a column repeats others


def feedback(played: Values, into: Values, out: Values, *, held: bool) -> float:
    """Return the fraction of what is new in the output that the input answers later [1]; zero where that may be chance.

    A sample of the output is predicted from the past of output and input. Without feedback what is left is independent of
    all inputs that come later, whatever their colour; what of it these explain, once they are predicted from the same past, is
    held against the F distribution.

    Args:
        played: the input.
        into: the same, or with cos(theta) counted as part of it.
        out: the output, without gaps.
        held: whether the input is held between samples, so that the output answers it one sample later at the earliest.

    Source: Sims, American Economic Review 62 (1972), the test by future inputs; Caines and Chan, IEEE Trans. Autom. Control 20
    (1975).
    """
    alike = np.array_equal(played, into)
    played, into, out = (values[:_LONGEST] - np.mean(values[:_LONGEST]) for values in (played, into, out))
    order, first = min(_ORDER, len(out) // 40), 0 if held else 1
    if order < 2:
        return 0.0
    at = np.arange(order, len(out) - _AHEAD - first)
    signals = (out, into) if alike else (out, into, played)
    past = np.stack(
        [signal[at - lag] for signal in signals for lag in range(1, order + 1)] + [np.ones(len(at))], axis=1
    )
    span = _span(past, past)
    later = np.stack([played[at + first + lag] for lag in range(_AHEAD)], axis=1)
    new = out[at] - span @ (span.T @ out[at])
    answers = _span(later - span @ (span.T @ later), later)
    left, explained = len(at) - span.shape[1] - answers.shape[1], float(np.sum((answers.T @ new) ** 2))
    whole = float(np.sum(new**2))
    if not answers.shape[1] or left < 1 or whole <= 0:
        return 0.0
    ratio = (explained / answers.shape[1]) / max((whole - explained) / left, 1e-300)
    by_chance = float(scipy.stats.f.sf(ratio, answers.shape[1], left))
    fraction = explained / whole
    return fraction if by_chance < _CHANCE and fraction > _LITTLE else 0.0


def _span(columns: Float64[np.ndarray, "sample column"], beside: Float64[np.ndarray, "sample column"]) -> np.ndarray:
    """Return an orthonormal basis of columns, of each what is no rounding beside its size in another matrix."""
    basis, strength, _ = np.linalg.svd(
        columns / np.maximum(np.linalg.norm(beside, axis=0), 1e-300), full_matrices=False
    )
    return basis[:, strength > _DEPENDENT * max(strength[0], 1.0)]
