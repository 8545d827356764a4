"""A stable minimum-phase weight that lies above a profile at every frequency and as close to it as its order allows."""

from collections.abc import Callable, Iterator
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.optimize import linprog

from estimators.uncertainty.magnitude_bound import Roots, magnitude_bound
from estimators.uncertainty.nominal_model import log_measure

Curve = Float64[np.ndarray, " frequency"]
Minimise = Literal["mean", "largest"]

_ROUNDS = 60
_ENOUGH = 1e-4  # gain of a round in the logarithm, below which it is the last
WEIGHT_STEPS = 6
"""How many searches `fit_weight` makes, each from another start."""
_REACH = (0.5, 1e-4)  # of the trust region in logarithms: at the start, and where it gives up
_DAMPING = 0.05  # smallest damping ratio, so that no notch hides between the points of a grid
_BEYOND = 100.0  # times the band, where corners may lie
_ABOVE = 1e-9  # by which the weight clears the profile, for rounding


class Shape(NamedTuple):
    """The weight gain * prod (s^2 + c s + d) / (s^2 + a s + b) * (s + q) / (s + p), everything as a logarithm.

    Attributes:
        gain: logarithm.
        pairs: rows of logarithms of c, d, a, b.
        single: rows of logarithms of q, p; one for an odd order, else none.
    """

    gain: float
    pairs: Float64[np.ndarray, "pair four"]
    single: Float64[np.ndarray, "single two"]

    def log_magnitude(self, omega: Curve) -> Curve:
        """Return log |W(j omega)|."""
        return self.gain + self._parts(omega)[0]

    def _parts(self, omega: Curve) -> tuple[Curve, Float64[np.ndarray, "parameter frequency"]]:
        """Return log |W| less the gain, and its derivative by the logarithms, pairs first."""
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
        """Return numerator and denominator, falling powers of s [rad/s]; all roots have negative real parts."""
        top, low = np.array([np.exp(self.gain)]), np.ones(1)
        for c, d, a, b in np.exp(self.pairs):
            top, low = np.polymul(top, [1.0, c, d]), np.polymul(low, [1.0, a, b])
        for q, p in np.exp(self.single):
            top, low = np.polymul(top, [1.0, q]), np.polymul(low, [1.0, p])
        return top, low


def fit_weight(
    omega: Curve, profile: Curve, *, order: int, minimise: Minimise, done: Callable[[], object], seed: int = 0
) -> Shape:
    """Fit the weight above the profile whose excess in decibels, its mean over log frequency or its largest, is smallest.

    The gain always lifts the weight onto the profile, so only its shape is searched: by linear programmes in the
    logarithms of its coefficients, which make it stable and minimum-phase whatever their values, within a trust region
    and from several starts, among them the magnitude of least largest excess. Damping ratios are at least 0.05 and
    corners within two decades of the band.

    Args:
        omega: [rad/s].
        profile: positive.
        order: zero or more.
        minimise: the mean or the largest excess.
        done: called after each search.
        seed: of the random starts.
    """
    target = np.log(profile)
    measure = log_measure(omega) if minimise == "mean" else None
    best, smallest = _lifted(Shape(0.0, np.zeros((0, 4)), np.zeros((0, 2))), omega, target), np.inf
    if order == 0:
        return best
    for start in _starts(omega, profile, order, seed):
        shape, value = _descend(_lifted(start, omega, target), omega, target, measure)
        done()
        if value < smallest:
            best, smallest = shape, value
    return best


def lift(shape: Shape, by: float) -> Shape:
    """Return the weight times exp(`by`)."""
    return shape._replace(gain=shape.gain + by)


def _lifted(shape: Shape, omega: Curve, target: Curve) -> Shape:
    return shape._replace(gain=float(np.max(target - shape._parts(omega)[0])) + _ABOVE)


def _starts(omega: Curve, profile: Curve, order: int, seed: int) -> Iterator[Shape]:
    """Yield `WEIGHT_STEPS` starts."""
    random = np.random.default_rng(seed)
    yield _start(omega, order, None)
    bound = magnitude_bound(omega, profile, order)
    yield _start(omega, order, random) if bound is None else _from_roots(*bound, omega)
    for _ in range(WEIGHT_STEPS - 2):
        yield _start(omega, order, random)


def _from_roots(zeros: Roots, poles: Roots, omega: Curve) -> Shape:
    """Return the weight of these roots, moved within the limits of damping and corners."""
    lowest, highest = _limits(omega, len(poles.pairs), len(poles.single))
    pairs = np.log(np.concatenate([zeros.pairs, poles.pairs], axis=1))
    single = np.log(np.stack([zeros.single, poles.single], axis=1))
    kept = np.clip(np.concatenate([pairs.ravel(), single.ravel()]), lowest, highest)
    pairs, single = kept[: pairs.size].reshape(-1, 4), kept[pairs.size :].reshape(-1, 2)
    pairs[:, ::2] = np.maximum(pairs[:, ::2], 0.5 * pairs[:, 1::2] + np.log(2 * _DAMPING))
    return Shape(0.0, pairs, single)


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


def _excess(shape: Shape, omega: Curve, target: Curve, measure: Curve | None) -> float:
    excess = shape.log_magnitude(omega) - target
    return float(np.max(excess) if measure is None else measure @ excess)


def _descend(shape: Shape, omega: Curve, target: Curve, measure: Curve | None) -> tuple[Shape, float]:
    """Lower the mean excess with this measure, or without one the largest excess."""
    value = _excess(shape, omega, target, measure)
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
        found = _excess(moved, omega, target, measure)
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
    """Return smallest and largest logarithms of all coefficients; the damping has a bound of its own."""
    low, high = np.log(omega[0] / _BEYOND), np.log(omega[-1] * _BEYOND)
    lowest = np.tile([low + np.log(2 * _DAMPING), 2 * low], 2 * pairs)
    highest = np.tile([high + np.log(20.0), 2 * high], 2 * pairs)
    return np.append(lowest, [low] * 2 * single), np.append(highest, [high] * 2 * single)


def _programme(
    shape: Shape, omega: Curve, target: Curve, measure: Curve | None, reach: float,
    limits: tuple[np.ndarray, np.ndarray],
) -> np.ndarray | None:  # fmt: skip
    """Return the step that lowers the excess of the tangent of log |W| most while it stays above the profile.

    It is the mean excess with a measure, else the largest.
    """
    value, slope = shape._parts(omega)
    now = np.concatenate([shape.pairs.ravel(), shape.single.ravel()])
    # Unknown are the step, the change of the gain, and the largest excess where that is made small.
    one, room = np.ones((len(omega), 1)), np.zeros((len(omega), 1 if measure is None else 0))
    rows, bounds = [np.hstack([-slope.T, -one, room])], [value - target]
    if measure is None:
        rows.append(np.hstack([slope.T, one, -one]))
        bounds.append(target - value)
    # log(linear coefficient) - log(constant) / 2 >= log(2 damping), for each pair above and below.
    count = 2 * len(shape.pairs)
    damping = np.zeros((count, rows[0].shape[1]))
    damping[np.arange(count), 2 * np.arange(count)] = -1.0
    damping[np.arange(count), 2 * np.arange(count) + 1] = 0.5
    spare = now[0 : 2 * count : 2] - 0.5 * now[1 : 2 * count : 2] - np.log(2 * _DAMPING)
    low = np.minimum(np.maximum(-reach, limits[0] - now), 0.0)
    high = np.maximum(np.minimum(reach, limits[1] - now), 0.0)
    cost = np.append(np.zeros(len(now) + 1), 1.0) if measure is None else np.append(slope @ measure, 1.0)
    found = linprog(
        cost,
        A_ub=np.concatenate([*rows, damping]),
        b_ub=np.concatenate([*bounds, np.maximum(spare, 0.0)]),
        bounds=[*zip(low, high, strict=True), *[(None, None)] * (len(cost) - len(now))],
        method="highs",
    )
    return found.x[: len(now)] if found.status == 0 else None
