"""Stable rational functions through complex data, by vector fitting."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex128, Float64

Poles = Complex128[np.ndarray, " pole"]

_SWEEPS = 15
_DAMPED = 1e-4  # smallest damping ratio of a pole


class Rational(NamedTuple):
    """A function N(s) / D(s) in a scaled s, with D in factors that are stable for any value of the logarithms.

    Attributes:
        numerator: coefficients, rising powers of s / scale.
        pairs: logarithms of a and b in s^2 + a s + b, one row each.
        single: logarithms of p in s + p; empty or one, for an odd order.
        scale: [rad/s].
    """

    numerator: Float64[np.ndarray, " power"]
    pairs: Float64[np.ndarray, "pair two"]
    single: Float64[np.ndarray, " single"]
    scale: float

    def denominator_factors(self, s: Complex128[np.ndarray, " frequency"]) -> tuple[np.ndarray, np.ndarray]:
        """Return values of the factors at the scaled s, [pair, frequency] and [single, frequency]."""
        a, b = np.exp(self.pairs[:, :1]), np.exp(self.pairs[:, 1:])
        return s * s + a * s + b, s + np.exp(self.single)[:, None]

    def __call__(self, omega: Float64[np.ndarray, " frequency"]) -> Complex128[np.ndarray, " frequency"]:
        """Return the response at frequencies [rad/s]."""
        s = 1j * omega / self.scale
        pairs, single = self.denominator_factors(s)
        return np.polynomial.polynomial.polyval(s, self.numerator) / (pairs.prod(axis=0) * single.prod(axis=0))

    def coefficients(self) -> tuple[np.ndarray, np.ndarray]:
        """Return numerator and denominator in s itself, falling powers, denominator monic."""
        denominator = np.ones(1)
        for a, b in np.exp(self.pairs):
            denominator = np.polymul(denominator, [1.0, a * self.scale, b * self.scale**2])
        for p in np.exp(self.single):
            denominator = np.polymul(denominator, [1.0, p * self.scale])
        order = len(denominator) - 1
        powers = np.arange(len(self.numerator))
        numerator = (self.numerator * self.scale ** (order - powers.astype(float)))[::-1]
        return numerator, denominator


def vector_fit(
    omega: Float64[np.ndarray, " frequency"],
    data: Complex128[np.ndarray, " frequency"],
    weight: Float64[np.ndarray, " frequency"],
    *,
    order: int,
    zeros: int,
) -> Rational:
    """Fit the stable rational function of this order with so many zeros to the data by weighted least squares.

    Poles start lightly damped and spread over the band; each sweep moves them to the zeros of a common denominator and
    reflects those that came out unstable.

    Source: Gustavsen and Semlyen (1999), Rational approximation of frequency domain responses by vector fitting.
    """
    scale = float(np.exp(np.mean(np.log(omega))))
    s = 1j * omega / scale
    spread = np.geomspace(s.imag[0], s.imag[-1], order // 2 + 2)[1:-1] if order > 1 else np.zeros(0)
    poles: Any = np.concatenate([-0.05 * spread + 1j * spread, -np.ones(order % 2)])
    for _ in range(_SWEEPS):
        basis, matrix, column = _partial_fractions(s, poles)
        left = np.concatenate([basis, np.ones((len(s), 1)), -data[:, None] * basis], axis=1) * weight[:, None]
        solution = _real_least_squares(left, weight * data)
        moved: Any = np.linalg.eigvals(matrix - np.outer(column, solution[order + 1 :]))
        moved = -np.abs(moved.real) + 1j * moved.imag
        size = np.maximum(np.abs(moved), 1e-3 * s.imag[0])
        moved = np.minimum(moved.real, -_DAMPED * size) + 1j * moved.imag
        fresh = _half(moved)
        # A pair that becomes two real poles changes how many these are.
        settled = len(fresh) == len(poles) and np.allclose(np.sort_complex(fresh), np.sort_complex(poles), rtol=1e-6)
        poles = fresh
        if settled:
            break
    pairs, single = _factors(poles, order)
    shape = Rational(np.ones(1), pairs, single, scale)
    denominator = 1.0 / shape(omega)
    powers = s[:, None] ** np.arange(zeros + 1)
    numerator = _real_least_squares(powers * (weight / denominator)[:, None], weight * data)
    return shape._replace(numerator=numerator)


def _half(poles: Any) -> Any:
    """Return one of each conjugate pair, then real ones; of an odd number of real ones the last stands alone."""
    upper = poles[poles.imag > 1e-12 * np.abs(poles)]
    real = np.sort(poles[np.abs(poles.imag) <= 1e-12 * np.abs(poles)].real)
    return np.concatenate([upper, real.astype(np.complex128)])


def _partial_fractions(s: np.ndarray, poles: Poles) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    columns, blocks, into = [], [], []
    for p in poles:
        if p.imag == 0:
            columns.append(1 / (s - p))
            blocks.append(np.array([[p.real]]))
            into += [1.0]
        else:
            one, other = 1 / (s - p), 1 / (s - p.conjugate())
            columns += [one + other, 1j * (one - other)]
            blocks.append(np.array([[p.real, p.imag], [-p.imag, p.real]]))
            into += [2.0, 0.0]
    size = sum(len(block) for block in blocks)
    matrix, at = np.zeros((size, size)), 0
    for block in blocks:
        matrix[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    return np.stack(columns, axis=1), matrix, np.array(into)


def _factors(poles: Poles, order: int) -> tuple[np.ndarray, np.ndarray]:
    pairs = [(-2 * p.real, abs(p) ** 2) for p in poles if p.imag != 0]
    real = [-p.real for p in poles if p.imag == 0]
    while len(real) > 1:
        one, other = real.pop(0), real.pop(0)
        pairs.append((one + other, one * other))
    assert 2 * len(pairs) + len(real) == order
    return np.log(np.array(pairs, dtype=float).reshape(-1, 2)), np.log(np.array(real, dtype=float))


def _real_least_squares(matrix: Any, target: Any) -> np.ndarray:
    """Solve complex equations for real unknowns, columns scaled."""
    stacked = np.concatenate([matrix.real, matrix.imag])
    scale = np.linalg.norm(stacked, axis=0)
    scale[scale == 0] = 1.0
    solution, *_ = np.linalg.lstsq(stacked / scale, np.concatenate([target.real, target.imag]), rcond=None)
    return solution / scale
