"""A stable minimum-phase weight that lies above a profile at every frequency and as close to it as its order allows."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.optimize import linprog

from estimators._nominal import log_measure

Curve = Float64[np.ndarray, " frequency"]

_ROUNDS = 60
_ENOUGH = 1e-4  # gain of a round in the mean logarithm, below which it is the last
WEIGHT_STEPS = 6
"""How many searches `fit_weight` makes, each from another start."""
_REACH = (0.5, 1e-4)  # of the trust region in logarithms: at the start, and where it gives up
_DAMPING = 0.05  # smallest damping ratio, so that no notch hides between the points of a grid
_BEYOND = 100.0  # times the band, where corners may lie
_ABOVE = 1e-9  # by which the weight clears the profile, for rounding


class Shape(NamedTuple):
    """gain * prod (s^2 + c s + d) / (s^2 + a s + b) * (s + q) / (s + p), everything as a logarithm.

    Attributes:
        gain: logarithm.
        pairs: rows of logarithms of c, d, a, b.
        single: rows of logarithms of q, p; one for an odd order, else none.
    """

    gain: float
    pairs: Float64[np.ndarray, "pair four"]
    single: Float64[np.ndarray, "single two"]

    def log_magnitude(self, omega: Curve) -> Curve:
        """log |W(j omega)|."""
        return self.gain + self._parts(omega)[0]

    def _parts(self, omega: Curve) -> tuple[Curve, Float64[np.ndarray, "parameter frequency"]]:
        """log |W| less the gain, and its derivative by the logarithms, pairs first."""
        value, rows = np.zeros(len(omega)), []
        s = 1j * omega
        for c, d, a, b in np.exp(self.pairs):
            top, low = s * s + c * s + d, s * s + a * s + b
            value = value + np.log(np.abs(top)) - np.log(np.abs(low))
            rows += [np.real(c * s / top), np.real(d / top), -np.real(a * s / low), -np.real(b / low)]
        for q, p in np.exp(self.single):
            value = value + np.log(np.abs(s + q)) - np.log(np.abs(s + p))
            rows += [np.real(q / (s + q)), -np.real(p / (s + p))]
        return value, np.array(rows).reshape(-1, len(omega))

    def coefficients(self) -> tuple[np.ndarray, np.ndarray]:
        """Numerator and denominator, falling powers of s [rad/s]; all roots have negative real parts."""
        top, low = np.array([np.exp(self.gain)]), np.ones(1)
        for c, d, a, b in np.exp(self.pairs):
            top, low = np.polymul(top, [1.0, c, d]), np.polymul(low, [1.0, a, b])
        for q, p in np.exp(self.single):
            top, low = np.polymul(top, [1.0, q]), np.polymul(low, [1.0, p])
        return top, low


def fit_weight(omega: Curve, profile: Curve, *, order: int, done: Callable[[], object], seed: int = 0) -> Shape:
    """The weight above the profile whose excess in decibels, averaged over log frequency, is smallest.

    The gain always lifts the weight onto the profile, so only its shape is searched: by linear programmes in the
    logarithms of its coefficients, which make it stable and minimum-phase whatever their values, within a trust region
    and from several starts. Damping ratios are at least 0.05 and corners within two decades of the band.

    Args:
        omega: [rad/s].
        profile: positive.
        order: zero or more.
        done: called after each search.
    """
    target = np.log(profile)
    measure = log_measure(omega)
    best, smallest = _lifted(Shape(0.0, np.zeros((0, 4)), np.zeros((0, 2))), omega, target), np.inf
    if order == 0:
        return best
    random = np.random.default_rng(seed)
    for number in range(WEIGHT_STEPS):
        shape = _lifted(_start(omega, order, None if number == 0 else random), omega, target)
        shape, value = _descend(shape, omega, target, measure)
        done()
        if value < smallest:
            best, smallest = shape, value
    return best


def lift(shape: Shape, by: float) -> Shape:
    """The weight times exp(`by`)."""
    return shape._replace(gain=shape.gain + by)


def _lifted(shape: Shape, omega: Curve, target: Curve) -> Shape:
    return shape._replace(gain=float(np.max(target - shape._parts(omega)[0])) + _ABOVE)


def _start(omega: Curve, order: int, random: np.random.Generator | None) -> Shape:
    low, high = np.log(omega[0]), np.log(omega[-1])
    count = order // 2
    if random is None:
        middles = np.linspace(low, high, count + 2)[1:-1] if count else np.zeros(0)
        tops = lows = middles
        damping = np.zeros((2, count))
        single = np.full((order % 2, 2), 0.5 * (low + high))
    else:
        tops, lows = random.uniform(low, high, (2, count))
        damping = random.uniform(np.log(0.1), np.log(2.0), (2, count))
        single = random.uniform(low, high, (order % 2, 2))
    pairs = np.stack([np.log(2) + damping[0] + tops, 2 * tops, np.log(2) + damping[1] + lows, 2 * lows], axis=1)
    return Shape(0.0, pairs, single)


def _descend(shape: Shape, omega: Curve, target: Curve, measure: Curve) -> tuple[Shape, float]:
    value = float(measure @ (shape.log_magnitude(omega) - target))
    reach = _REACH[0]
    limits = _limits(omega, len(shape.pairs), len(shape.single))
    for _ in range(_ROUNDS):
        step = _programme(shape, omega, target, measure, reach, limits)
        if step is None:
            break
        count = shape.pairs.size
        moved = shape._replace(
            pairs=shape.pairs + step[:count].reshape(-1, 4), single=shape.single + step[count:].reshape(-1, 2)
        )
        moved = _lifted(moved, omega, target)
        found = float(measure @ (moved.log_magnitude(omega) - target))
        if found < value - 1e-12:
            gained = value - found
            shape, value, reach = moved, found, min(2 * reach, 2.0)
            if gained < _ENOUGH:
                break
        else:
            reach *= 0.3
            if reach < _REACH[1]:
                break
    return shape, value


def _limits(omega: Curve, pairs: int, single: int) -> tuple[np.ndarray, np.ndarray]:
    """Smallest and largest logarithms of all coefficients; the damping has a bound of its own."""
    low, high = np.log(omega[0] / _BEYOND), np.log(omega[-1] * _BEYOND)
    lowest = np.tile([low + np.log(2 * _DAMPING), 2 * low], 2 * pairs)
    highest = np.tile([high + np.log(20.0), 2 * high], 2 * pairs)
    return np.append(lowest, [low] * 2 * single), np.append(highest, [high] * 2 * single)


def _programme(
    shape: Shape, omega: Curve, target: Curve, measure: Curve, reach: float, limits: tuple[np.ndarray, np.ndarray]
) -> np.ndarray | None:
    """The step that lowers the mean of the tangent of log |W| most while it stays above the profile."""
    value, slope = shape._parts(omega)
    now = np.concatenate([shape.pairs.ravel(), shape.single.ravel()])
    above = np.concatenate([-slope.T, -np.ones((len(omega), 1))], axis=1)
    # log(linear coefficient) - log(constant) / 2 >= log(2 damping), for each pair above and below.
    count = 2 * len(shape.pairs)
    damping = np.zeros((count, len(now) + 1))
    damping[np.arange(count), 2 * np.arange(count)] = -1.0
    damping[np.arange(count), 2 * np.arange(count) + 1] = 0.5
    spare = now[0 : 2 * count : 2] - 0.5 * now[1 : 2 * count : 2] - np.log(2 * _DAMPING)
    low = np.minimum(np.maximum(-reach, limits[0] - now), 0.0)
    high = np.maximum(np.minimum(reach, limits[1] - now), 0.0)
    found = linprog(
        np.append(slope @ measure, 1.0),
        A_ub=np.concatenate([above, damping]),
        b_ub=np.concatenate([value - target, np.maximum(spare, 0.0)]),
        bounds=[*zip(low, high, strict=True), (None, None)],
        method="highs",
    )
    return found.x[:-1] if found.status == 0 else None
