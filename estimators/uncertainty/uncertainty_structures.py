"""Structures of unstructured uncertainty: the model error of plants about a nominal one, and which plants matter."""

from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Complex128
from scipy.spatial import ConvexHull, QhullError

Kind = Literal["multiplicative_output", "multiplicative_input", "additive", "inverse_multiplicative"]
KINDS: tuple[Kind, ...] = ("multiplicative_output", "multiplicative_input", "additive", "inverse_multiplicative")

Plants = Complex128[np.ndarray, "condition frequency"]
Nominal = Complex128[np.ndarray, " frequency"]

_LAWSON = 300  # sweeps; the weights of plants inside the disc die out geometrically
_FARTHEST = 10.0  # times the largest plant, where a centre may lie when the plants surround zero


def errors(plants: Plants, nominal: Nominal, kind: Kind) -> Plants:
    """Return Delta W as a complex number: what has to be at most |W| in magnitude.

    P = (1 + Delta W) P_0 for "multiplicative_output" and "multiplicative_input", which are one for a scalar plant,
    P = P_0 + Delta W for "additive" and P = P_0 / (1 + Delta W) for "inverse_multiplicative".
    """
    if kind == "additive":
        return plants - nominal
    if kind == "inverse_multiplicative":
        return nominal / plants - 1.0
    return plants / nominal - 1.0


def slopes(plants: Plants, nominal: Nominal, kind: Kind) -> Plants:
    """Return the derivative of `errors` by the logarithm of the nominal response."""
    if kind == "additive":
        return np.broadcast_to(-nominal, plants.shape)
    if kind == "inverse_multiplicative":
        return nominal / plants
    return -plants / nominal


def corners(plants: Plants, kind: Kind) -> Bool[np.ndarray, "condition frequency"]:
    """Return which plants are corners of the convex hull at each frequency.

    Whatever the nominal, the largest model error is at one of them. For the inverse kind the hull is that of 1 / P.
    """
    points = 1.0 / plants if kind == "inverse_multiplicative" else plants
    found = np.zeros(points.shape, dtype=bool)
    for column in range(points.shape[1]):
        z: Any = points[:, column]
        try:
            if len(z) < 4:
                raise QhullError
            found[ConvexHull(np.stack([z.real, z.imag], axis=1)).vertices, column] = True
        except QhullError:
            # Too few, or all on one line, whose ends are the extremes in its own direction.
            away = z - z[np.argmax(np.abs(z - z[0]))]
            along = np.real(away * np.conj(away[np.argmax(np.abs(away))]))
            ends = np.arange(len(z)) if len(z) < 4 else np.array([np.argmin(along), np.argmax(along)])
            found[ends, column] = True
    return found


def packed(plants: Plants, kept: Bool[np.ndarray, "condition frequency"]) -> Complex128[np.ndarray, "corner frequency"]:
    """Stack the kept plants of each frequency on top of each other; where there are fewer, the last is repeated."""
    order = np.argsort(~kept, axis=0, kind="stable")
    count = kept.sum(axis=0)
    rows = np.minimum(np.arange(int(count.max()))[:, None], count - 1)
    columns = np.arange(plants.shape[1])
    return plants[order[rows, columns], columns]


def centres(plants: Complex128[np.ndarray, "corner frequency"], kind: Kind) -> Nominal:
    """Return the nominal response with the smallest largest model error at each frequency by itself.

    No rational one can beat it. By Lawson's reweighted least squares; the model error is a convex function of P_0, 1 /
    P_0 or both, so there is one minimum.
    """
    # |P z - 1| with z = 1 / P_0; |P_0 a - 1| with a = 1 / P; |P - P_0|.
    a = {"additive": np.ones_like(plants), "inverse_multiplicative": 1.0 / plants}.get(kind, plants)
    b = plants if kind == "additive" else np.ones_like(plants)
    weight = np.full(plants.shape, 1.0 / len(plants))
    best = np.zeros(plants.shape[1], dtype=np.complex128)
    smallest = np.full(plants.shape[1], np.inf)
    for _ in range(_LAWSON):
        x = np.sum(weight * a.conj() * b, axis=0) / np.sum(weight * np.abs(a) ** 2, axis=0)
        left = np.abs(a * x - b)
        worst = left.max(axis=0)
        better = worst < smallest
        best, smallest = np.where(better, x, best), np.where(better, worst, smallest)
        weight = weight * (left / np.maximum(worst, 1e-300) + 1e-12)
        weight /= weight.sum(axis=0)
    if kind in ("additive", "inverse_multiplicative"):
        return best
    least = 1.0 / (_FARTHEST * np.abs(plants).max(axis=0))
    return 1.0 / np.where(np.abs(best) < least, least, best)
