"""Selection of what differs between experiments: the fewest parameters that, free in each, explain it, or one experiment alone."""

import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy.stats
from jaxtyping import Float

# Of an eigenvalue to the largest; less than this is nothing that an experiment shows.
SHOWN = 1e-4
_NAMED = 3  # parameters that are named
NEXT_TO_ALL = 0.95  # fraction of the differences, beyond which what is left is of no consequence
ENOUGH = 4  # experiments, of which three may be alike without the fourth: two would always be more alike than three

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
    return max(whole - together, 0.0), max(1, rank - least)


def _drop(matrix: np.ndarray, gradient: np.ndarray) -> tuple[float, int]:
    """Return twice what the log-likelihood gains from here to its maximum, and how many directions are shown."""
    diagonal = np.sqrt(np.maximum(np.diagonal(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(diagonal, diagonal))
    kept = values > SHOWN * np.max(values, initial=0.0)
    return float(np.sum((vectors[:, kept].T @ (gradient / diagonal)) ** 2 / values[kept])), int(np.sum(kept))


class Chosen(NamedTuple):
    """The fewest parameters that explain that experiments differ.

    Attributes:
        places: of them, the one that explains most by itself first.
        fraction: of the chi-square that they explain together.
        rival: the same of the best other set of as many.
        suffices: whether what is left is what chance leaves, or next to nothing, and experiments are followed with it.
    """

    places: tuple[int, ...]
    fraction: float
    rival: float
    suffices: bool


def selected(
    information: Information,
    slope: Slope,
    level: float,
    *,
    followed: Callable[[Sequence[int]], bool] = lambda free: True,
) -> Chosen:
    """Return the fewest parameters that explain that experiments differ, of all sets of one, two and three.

    Taken one after the other, a parameter that goes along with two others would come first though it does not differ itself.

    Args:
        information: of each experiment.
        slope: gradient of each experiment's log-likelihood.
        level: at which they differ.
        followed: whether the experiments are followed with these parameters free in each: a small change of what shows much may be
            next to nothing of the differences, and most of the residual.
    """
    parameters = slope.shape[1]
    whole, freedom = explained(information, slope, range(parameters))
    found = Chosen((), 0.0, 0.0, True)
    if not scipy.stats.chi2.sf(whole, freedom) < level:
        return found
    for size in range(1, min(_NAMED, parameters) + 1):
        sets = {free: explained(information, slope, free) for free in itertools.combinations(range(parameters), size)}
        order = sorted(sets, key=lambda free: -sets[free][0])
        enough = [free for free in order if _explains(*sets[free], whole, freedom, level) and followed(free)]
        best, suffices = (enough or order)[0], bool(enough)
        gained = sets[best][0]
        rival = max((sets[free][0] for free in order if free != best), default=0.0)
        alone = sorted(best, key=lambda p: -explained(information, slope, [p])[0])
        found = Chosen(tuple(alone), min(gained / whole, 1.0), rival / whole, suffices)
        if suffices:
            break
    return found


def _explains(gained: float, spent: int, whole: float, freedom: int, level: float) -> bool:
    """Return whether what is left of a chi-square is what chance leaves, or next to nothing."""
    left = scipy.stats.chi2.sf(max(whole - gained, 0.0), max(1, freedom - spent))
    return bool(left >= level) or gained > NEXT_TO_ALL * whole


def is_followed(information: Information, slope: Slope, samples: int, free: Sequence[int]) -> bool:
    """Return whether what these parameters, free in each experiment, leave of the differences is less than the noise.

    Args:
        information: of each experiment.
        slope: gradient of each experiment's log-likelihood.
        samples: number of measured values, each of which the noise adds one to the squared residual.
        free: places of the parameters.
    """
    whole, _ = explained(information, slope, range(slope.shape[1]))
    return whole - explained(information, slope, free)[0] < samples


def left_without(information: Information, slope: Slope) -> tuple[tuple[float, int], ...]:
    """Return chi-square and freedom of the differences between the others, all parameters free in each, without each experiment.

    Args:
        information: of each experiment.
        slope: gradient of each experiment's log-likelihood.
    """
    every = range(slope.shape[1])
    return tuple(explained(np.delete(information, e, 0), np.delete(slope, e, 0), every) for e in range(slope.shape[0]))


class Outlying(NamedTuple):
    """The one experiment without which the others differ by no more than chance.

    Attributes:
        place: of it.
        chi_square, freedom: of the differences between the others.
    """

    place: int
    chi_square: float
    freedom: int


def outlying(information: Information, slope: Slope, level: float) -> Outlying | None:
    """Return the one experiment without which next to nothing of the differences is left, and no more than chance makes.

    All parameters are free in each. Where all scatter, a few of their deviations, the others of the farthest may pass by chance;
    but more than next to nothing is left then.

    Args:
        information: of each experiment.
        slope: gradient of each experiment's log-likelihood.
        level: at which all together differ, and without any other still do.

    Returns:
        None where experiments are fewer than four or do not differ, or there is no such one, or more than one.
    """
    count, parameters = slope.shape
    whole, freedom = explained(information, slope, range(parameters))
    if count < ENOUGH or scipy.stats.chi2.sf(whole, freedom) >= level:
        return None
    left = left_without(information, slope)
    alike = [e for e in range(count) if scipy.stats.chi2.sf(*left[e]) >= level]
    if len(alike) != 1 or left[alike[0]][0] > (1 - NEXT_TO_ALL) * whole:
        return None
    return Outlying(alike[0], *left[alike[0]])
