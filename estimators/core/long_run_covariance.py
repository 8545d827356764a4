"""The long-run covariance of scores: what their sum scatters by, whatever their colour and however unequal they are."""

import numpy as np
from jaxtyping import Float


def long_run_covariance(
    scores: Float[np.ndarray, "experiment sample parameter"],
) -> tuple[Float[np.ndarray, "parameter parameter"], int]:
    """Return the covariance of the sum of all scores, and the lag up to which their products are summed [samples].

    Products of scores of one experiment are summed under Bartlett's window, as wide as their correlation asks.

    Args:
        scores: derivatives of the likelihood of every sample by the parameters, independent between experiments.

    Source: Newey and West, Econometrica 55 (1987); Andrews, Econometrica 59 (1991).
    """
    found = np.einsum("ksp,ksq->pq", scores, scores)
    lag = _bandwidth(scores)
    for k in range(1, lag + 1):
        shifted = np.einsum("ksp,ksq->pq", scores[:, k:], scores[:, :-k])
        found += (1 - k / (lag + 1)) * (shifted + shifted.T)
    return found, lag


def _bandwidth(scores: Float[np.ndarray, "experiment sample parameter"]) -> int:
    """Return Andrews' bandwidth for Bartlett's window, from the correlation of neighbouring scores.

    It is the largest of all parameters'.
    """
    power = np.sum(scores**2, axis=(0, 1))
    near = np.sum(scores[:, 1:] * scores[:, :-1], axis=(0, 1)) / np.where(power > 0, power, 1.0)
    rho = float(np.clip(np.max(near, initial=0.0), 0.0, 0.99))
    samples = scores.shape[1]
    wide = 1.1447 * (4 * rho**2 / (1 - rho**2) ** 2 * samples) ** (1 / 3)
    return int(min(np.ceil(wide), samples // 4))
