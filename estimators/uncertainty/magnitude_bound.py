"""The rational magnitude above a profile whose largest excess is smallest: a quasiconvex problem, with no local minima.

|W(j omega)|^2 = N(x) / D(x) with polynomials of x = omega^2. That N / D lies between the profile squared and t times it is
linear in the coefficients, so t is found by bisection over linear programmes (S. Boyd and L. Vandenberghe, Convex
Optimization, 2004, section 4.2.5), and the roots of N and D give stable and minimum-phase factors of W. Powers of x span so
many decades that from some seven poles on rounding decides; what is found then is a bound, but may not be the least.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Int64
from scipy.optimize import linprog

Curve = Float64[np.ndarray, " frequency"]
Terms = Float64[np.ndarray, " term"]

_STEPS = 40  # bisections of the logarithm
_LARGEST = 20.0  # logarithm of t, above which no bound is looked for
_CLOSE = 1e-4  # of that logarithm
_MORE = 400  # frequencies at which N and D have to be positive, over two decades more on either side
_BEYOND = 100.0
_POSITIVE = 1e-9  # of the sum of the absolute terms


class Roots(NamedTuple):
    """The quadratic factors s^2 + c s + d and linear factors s + q of a polynomial without its gain.

    Attributes:
        pairs: rows of c, d.
        single: q; one for an odd order, else none.
    """

    pairs: Float64[np.ndarray, "pair two"]
    single: Float64[np.ndarray, " single"]


def magnitude_bound(omega: Curve, profile: Curve, order: int) -> tuple[Roots, Roots] | None:
    """Return zeros and poles of the bound; None where the programmes cannot be solved in double precision.

    Args:
        omega: [rad/s], rising.
        profile: positive.
        order: at least one.
    """
    middle = np.sqrt(omega[0] * omega[-1])
    powers = np.arange(order + 1)
    more = np.geomspace(omega[0] / _BEYOND, omega[-1] * _BEYOND, _MORE) / middle
    low, high, found = 0.0, _LARGEST, None
    for _ in range(_STEPS):
        level = 0.5 * (low + high)
        one = _feasible(omega / middle, profile**2, float(np.exp(level)), powers, more)
        if one is None:
            low = level
        else:
            high, found = level, one
        if high - low < _CLOSE:
            break
    if found is None:
        return None
    zeros, poles = (_factors(part, middle) for part in found)
    return None if zeros is None or poles is None else (zeros, poles)


def _feasible(
    at: Curve, squared: Curve, level: float, powers: Int64[np.ndarray, " term"], more: Float64[np.ndarray, " wide"]
) -> tuple[Terms, Terms] | None:
    """Return coefficients of N and D, rising powers of x, with squared <= N / D <= level * squared, or None."""

    def rows(frequency: Float64[np.ndarray, " row"]) -> Float64[np.ndarray, "row term"]:
        terms = frequency[:, None] ** (2 * powers)
        return terms / terms.sum(axis=1, keepdims=True)

    terms, wide = rows(at), rows(more)
    none = np.zeros_like(wide)
    above = np.hstack([-terms / squared[:, None], terms])
    below = np.hstack([terms / (level * squared)[:, None], -terms])
    positive = np.vstack([np.hstack([-wide, none]), np.hstack([none, -wide])])
    count = 2 * len(powers)
    solved = linprog(
        np.zeros(count),
        A_ub=np.vstack([above, below, positive]),
        b_ub=np.append(np.zeros(2 * len(at)), np.full(len(positive), -_POSITIVE)),
        A_eq=np.append(np.zeros(len(powers)), np.ones(len(powers)))[None],
        b_eq=[1.0],
        bounds=(None, None),
        method="highs",
    )
    return (solved.x[: len(powers)], solved.x[len(powers) :]) if solved.status == 0 else None


def _factors(coefficients: Terms, middle: float) -> Roots | None:
    """Return the roots of the spectral factor: x = -s^2, and of each s the root in the left half plane."""
    squares: Any = np.roots(coefficients[::-1]).astype(complex)
    if len(squares) != len(coefficients) - 1:
        return None
    # A real root is positive only where the polynomial was not looked at: a corner far outside the band.
    real = np.abs(squares.imag) <= 1e-12 * np.abs(squares)
    squares[real] = -np.abs(squares[real])
    found = -np.sqrt(-squares) * middle
    oscillating = found[found.imag > 1e-9 * np.abs(found)]
    real = np.sort(-found[np.abs(found.imag) <= 1e-9 * np.abs(found)].real)
    if 2 * len(oscillating) + len(real) != len(found) or np.any(found.real >= 0):
        return None
    pairs = [[-2 * s.real, abs(s) ** 2] for s in oscillating]
    pairs += [[a + b, a * b] for a, b in zip(real[0 : len(real) // 2 * 2 : 2], real[1::2], strict=True)]
    return Roots(np.array(pairs).reshape(-1, 2), real[len(real) // 2 * 2 :])
