"""Which parameters differ between experiments: the fewest that, free in each, explain that one set for all does not fit."""

from collections.abc import Sequence

import numpy as np
import scipy.stats
from jaxtyping import Float

# Of an eigenvalue to the largest; less than this is nothing that an experiment shows.
SHOWN = 1e-4
_NAMED = 3  # parameters that are named

Information = Float[np.ndarray, "experiment parameter parameter"]
Slope = Float[np.ndarray, "experiment parameter"]


def explained(information: Information, slope: Slope, free: Sequence[int]) -> tuple[float, int]:
    """Return chi-square and freedom of these parameters being free in each experiment, with the others common to all.

    Beside the fit in which all are common.
    """
    count, parameters = slope.shape
    size = 1 / np.sqrt(np.maximum(np.diagonal(np.sum(information, axis=0)), 1e-300))
    scaled, scores = information * np.outer(size, size), slope * size
    common = [p for p in range(parameters) if p not in free]
    edges = len(common) + len(free) * np.arange(count + 1)
    matrix, gradient = np.zeros((edges[-1], edges[-1])), np.zeros(edges[-1])
    matrix[: len(common), : len(common)] = np.sum(scaled, axis=0)[np.ix_(common, common)]
    gradient[: len(common)] = np.sum(scores, axis=0)[common]
    for e in range(count):
        own = slice(edges[e], edges[e + 1])
        matrix[own, own] = scaled[e][np.ix_(free, free)]
        matrix[own, : len(common)] = scaled[e][np.ix_(free, common)]
        matrix[: len(common), own] = matrix[own, : len(common)].T
        gradient[own] = scores[e][list(free)]
    whole, rank = _drop(matrix, gradient)
    together, least = _drop(np.sum(scaled, axis=0), np.sum(scores, axis=0))
    return whole - together, max(1, rank - least)


def _drop(matrix: np.ndarray, gradient: np.ndarray) -> tuple[float, int]:
    """Return twice what the log-likelihood gains from here to its maximum, and how many directions are shown."""
    diagonal = np.sqrt(np.maximum(np.diagonal(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(diagonal, diagonal))
    kept = values > SHOWN * np.max(values, initial=0.0)
    return float(np.sum((vectors[:, kept].T @ (gradient / diagonal)) ** 2 / values[kept])), int(np.sum(kept))


def selected(information: Information, slope: Slope, level: float) -> tuple[list[int], list[float]]:
    """Return the fewest parameters that explain that experiments differ, and which fraction of it each set explains.

    One after the other that which explains most beside those before it, until what is left is what chance leaves, or the next
    explains no more than chance.
    """
    parameters = slope.shape[1]
    whole, freedom = explained(information, slope, range(parameters))
    chosen: list[int] = []
    fractions: list[float] = []
    so_far, spent = 0.0, 0
    while (
        len(chosen) < min(_NAMED, parameters) and scipy.stats.chi2.sf(whole - so_far, max(1, freedom - spent)) < level
    ):
        further = {p: explained(information, slope, [*chosen, p]) for p in range(parameters) if p not in chosen}
        best = max(further, key=lambda p: further[p][0])
        gained, used = further[best][0] - so_far, max(1, further[best][1] - spent)
        if scipy.stats.chi2.sf(gained, used) > level / len(further):
            break
        chosen.append(best)
        so_far, spent = further[best]
        fractions.append(min(so_far / whole, 1.0) if whole > 0 else 0.0)
    return chosen, fractions
