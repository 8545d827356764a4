"""The stable linear model of chosen order that is least far from all plants at once."""

from collections.abc import Callable, Sequence

import numpy as np
import scipy.sparse
from jaxtyping import Complex128, Float64
from scipy.optimize import linprog

from estimators.uncertainty.uncertainty_structures import Kind, centres, errors, slopes
from estimators.uncertainty.vector_fitting import Rational, vector_fit

_ROUNDS = 40
_ENOUGH = 1e-4  # relative gain of a round, below which it is the last
_CORNERS = 4  # farthest plants of each frequency that bound a step
_SLACK = 1.01  # by which the largest model error may grow where that makes the others smaller
_PENALTY = 10.0  # of the mean model error, for what lies above that
_STARTS = 2  # of the fits, the best ones are refined

Plants = Complex128[np.ndarray, "corner frequency"]
Curve = Float64[np.ndarray, " frequency"]
NOMINAL_STEPS = 2 * _STARTS + 1
"""How many searches `nominal_fit` makes."""


def nominal_fit(
    omega: Curve, plants: Plants, kind: Kind, *, order: int, zeros: int, importance: Curve, done: Callable[[], object]
) -> Rational:
    """Fit the stable rational function whose largest model error about the plants, times importance, is smallest.

    Vector fits through the centres of the smallest discs about the plants, and through their means, are starts; from
    the best, a sequence of linear programmes inside a trust region lowers the largest model error until it stays. Then,
    with that held within 1 %, the mean over log frequency is lowered, as the largest error alone says nothing about the
    rest. `done` is called after each search.
    """
    middle = centres(plants, kind)
    starts = []
    for target in (middle, plants.mean(axis=0), np.exp(_mean_log(plants))):
        weight = importance if kind == "additive" else importance / np.abs(target)
        starts.append(vector_fit(omega, target, weight, order=order, zeros=zeros))
    starts.sort(key=lambda fit: _largest(fit, omega, plants, kind, importance))

    def searched(fit: Rational, ceiling: float | None) -> Rational:
        found = _descend(fit, omega, plants, kind, importance, ceiling)
        done()
        return found

    refined = [searched(fit, None) for fit in starts[:_STARTS]]
    ceiling = _SLACK * min(_largest(fit, omega, plants, kind, importance) for fit in refined)
    # The best fit lies nearer to most plants than what came of it, and may lead to another minimum.
    settled = [searched(fit, ceiling) for fit in (*refined, starts[0])]
    return min(
        settled,
        key=lambda fit: _merit(_model_errors(fit, omega, plants, kind, importance), log_measure(omega), ceiling),
    )


def log_measure(omega: Curve) -> Curve:
    """Return weights that make a sum over the grid a mean over log frequency."""
    edges = np.log(omega)
    width = np.gradient(edges) if len(omega) > 1 else np.ones(1)
    return width / width.sum()


def _mean_log(plants: Plants) -> Complex128[np.ndarray, " frequency"]:
    """Return the logarithm of the geometric mean, phases unwrapped about that of the sum."""
    turn = np.exp(1j * np.angle(plants.sum(axis=0)))
    return np.log(plants / turn).mean(axis=0) + np.log(turn)


def _model_errors(
    fit: Rational, omega: Curve, plants: Plants, kind: Kind, importance: Curve
) -> Float64[np.ndarray, "corner frequency"]:
    return np.abs(errors(plants, fit(omega), kind)) * importance


def _largest(fit: Rational, omega: Curve, plants: Plants, kind: Kind, importance: Curve) -> float:
    return float(np.max(_model_errors(fit, omega, plants, kind, importance)))


def _descend(
    fit: Rational, omega: Curve, plants: Plants, kind: Kind, importance: Curve, ceiling: float | None
) -> Rational:
    """Lower the largest model error, or below a ceiling the mean one, by linear programmes within a trust region."""
    measure = log_measure(omega)

    def merit(candidate: Rational) -> float:
        return _merit(_model_errors(candidate, omega, plants, kind, importance), measure, ceiling)

    reach, value = 0.2, merit(fit)
    for _ in range(_ROUNDS):
        step = _programme(fit, omega, plants, kind, importance, reach, measure, ceiling)
        if step is None:
            break
        candidate = _moved(fit, step)
        found = merit(candidate)
        if found < value:
            gained = value - found
            fit, value = candidate, found
            reach = min(2 * reach, 1.0)
            if gained < _ENOUGH * value:
                break
        else:
            reach *= 0.3
            if reach < 1e-5:
                break
    return fit


def _merit(model_errors: Float64[np.ndarray, "corner frequency"], measure: Curve, ceiling: float | None) -> float:
    profile = model_errors.max(axis=0)
    if ceiling is None:
        return float(profile.max())
    # An exact penalty: a step along a curved bound leaves it by a little, and may.
    return float(measure @ profile) + _PENALTY * max(0.0, float(profile.max()) - ceiling)


def _sensitivity(fit: Rational, omega: Curve) -> tuple[Complex128[np.ndarray, "parameter frequency"], np.ndarray]:
    """Return the derivative of the response's logarithm by the parameters, and the size of a unit step in each."""
    s = 1j * omega / fit.scale
    pairs, single = fit.denominator_factors(s)
    numerator = np.polynomial.polynomial.polyval(s, fit.numerator)
    a, b, p = np.exp(fit.pairs[:, :1]), np.exp(fit.pairs[:, 1:]), np.exp(fit.single)[:, None]
    powers = s[None, :] ** np.arange(len(fit.numerator))[:, None]
    rows = [powers / numerator, -a * s / pairs, -b / pairs, -p / single]
    # A unit step in a coefficient changes the response by a factor of e somewhere, as a step in a logarithm does.
    sizes = np.concatenate([1.0 / np.max(np.abs(rows[0]), axis=1), np.ones(2 * len(a) + len(p))])
    return np.concatenate(rows), sizes


def _moved(fit: Rational, step: np.ndarray) -> Rational:
    count, pairs = len(fit.numerator), len(fit.pairs)
    parts = np.split(step, [count, count + pairs, count + 2 * pairs])
    moved = fit.pairs + np.stack([parts[1], parts[2]], axis=1)
    # A pole on the imaginary axis would be stable in name only.
    moved[:, 0] = np.maximum(moved[:, 0], 0.5 * moved[:, 1] + np.log(2e-4))
    return fit._replace(numerator=fit.numerator + parts[0], pairs=moved, single=fit.single + parts[3])


def _programme(
    fit: Rational, omega: Curve, plants: Plants, kind: Kind, importance: Curve, reach: float, measure: Curve,
    ceiling: float | None,
) -> np.ndarray | None:  # fmt: skip
    """Return the step that lowers the merit most where model errors are replaced by their tangents."""
    nominal = fit(omega)
    error = errors(plants, nominal, kind)
    size = np.abs(error)
    few = min(_CORNERS, len(plants))
    rows = np.argpartition(-size, few - 1, axis=0)[:few]
    columns = np.broadcast_to(np.arange(len(omega)), rows.shape)
    by_log = (error[rows, columns].conj() / np.maximum(size[rows, columns], 1e-300)) * slopes(plants, nominal, kind)[
        rows, columns
    ]
    sensitivity, sizes = _sensitivity(fit, omega)
    tangent = np.real(by_log[:, None, :] * sensitivity) * (
        sizes[:, None] * importance
    )  # [corner, parameter, frequency]
    model_errors = size[rows, columns] * importance
    count, lines = len(sizes), len(omega)
    matrix = np.moveaxis(tangent, 1, 2).reshape(-1, count)
    bounds: Sequence[tuple[float, float | None]] = [(-reach, reach)] * count
    right = -model_errors.ravel()
    if ceiling is None:
        left = np.concatenate([matrix, -np.ones((len(matrix), 1))], axis=1)
        cost = np.append(np.zeros(count), 1.0)
        bounds = [*bounds, (0.0, None)]
    else:
        tops = scipy.sparse.csr_matrix(
            (-np.ones(few * lines), (np.arange(few * lines), np.tile(np.arange(lines), few))),
            shape=(few * lines, lines),
        )
        over = scipy.sparse.hstack(
            [scipy.sparse.csr_matrix((lines, count)), scipy.sparse.identity(lines), -np.ones((lines, 1))]
        )
        inside = scipy.sparse.hstack([scipy.sparse.csr_matrix(matrix), tops, scipy.sparse.csr_matrix((few * lines, 1))])
        left = scipy.sparse.vstack([inside, over]).tocsr()
        cost = np.concatenate([np.zeros(count), measure, [_PENALTY]])
        right = np.concatenate([right, np.full(lines, ceiling)])
        bounds = [*bounds, *[(0.0, None)] * (lines + 1)]
    found = linprog(cost, A_ub=left, b_ub=right, bounds=bounds, method="highs")
    return found.x[:count] * sizes if found.status == 0 else None
