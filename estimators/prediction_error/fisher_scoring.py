"""Fisher scoring to the maximum of the likelihood itself, in which the gains of the filter follow the physics."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from estimators.core.bound_transform import to_unconstrained
from estimators.core.data import Data
from estimators.core.deadline import require_time
from estimators.core.fisher_information import Information, each_deviations, each_slope, information, sizes_of, slope_of
from estimators.core.parameter_space import Space, Unknowns
from estimators.core.results import DivergedError
from estimators.prediction_error.filter_pass import run_filter
from estimators.prediction_error.noise_estimation import Noise, Predictor, fit_noise
from estimators.prediction_error.noise_model import NoiseModel
from rtac_jax import RTAC
from rtac_jax.simulation import Steps

# The likelihood is differenced over this fraction of a standard deviation to either side: dry friction has steps, which a
# derivative at a point would see, or miss. What is hardly known moves by a fraction of its size.
_REACH, _FRACTION = 0.25, 0.1
_NOISE_REACH = 0.02  # in the logarithm of a variance
# Gain in log-likelihood that a step must promise; less moves nothing by more than a fifth of its deviation.
_WORTH = 0.02
_STEPS = 8
_SHORTER = (1.0, 0.5, 0.25, 0.1)
_INSIDE = 1e-9  # of its scale, how near to a bound a parameter may end
_NOTHING = 1e-100  # far below a column that shows anything, and more than none


class _Point(NamedTuple):
    """The free shared parameters, and those of each experiment, SI units."""

    shared: Float[np.ndarray, " shared"]
    each: Float[np.ndarray, "each experiment"]


class _Seen(NamedTuple):
    """The prediction errors in units of their standard deviation, and the inverse of that; zero where none count."""

    white: Float[np.ndarray, "sample output experiment"]
    weight: Float[np.ndarray, "sample output experiment"]


def most_likely(
    found: Predictor, model: RTAC, data: Data, space: Space, prior: NoiseModel,
    frozen: Float[np.ndarray, "experiment frozen frozen"], *, substeps: Steps, progress: Callable[[str], None],
) -> tuple[Predictor, Float[np.ndarray, "experiment row column"]]:  # fmt: skip
    """Go on from a fit with frozen gains to the maximum of the likelihood, by Fisher's scoring.

    With the gains frozen, a parameter that changes them, as the gain of a sensor does, seems better known than it is: part of
    its slope is random, and vanishes once the gains follow. On rigs with large random forces its standard
    deviation came out at half of what it was, and the estimate was not the likeliest.

    The noise is estimated too. If it counted as known, the size of what shakes the arm would tell the arm's inertia where
    nothing else does.

    Args:
        found: the predictor with frozen gains.
        model: of the physics.
        data: of all experiments.
        space: of the parameters.
        prior: of the noise.
        frozen: triangular factors with frozen gains; they set the steps of the differences.
        substeps: of the integrator in each sample.
        progress: called with a line of text at each step.

    Returns:
        The predictor there, and triangular factors as `information` takes them. The noise is projected out of the shared
        parameters; beside those of each experiment it counts as known, which makes their deviations a few per cent too small.

    Raises:
        DivergedError: the model diverges beside the estimate.

    Source: Gupta and Mehra, IEEE Transactions on Automatic Control 19 (1974).
    """
    inside = np.flatnonzero(np.asarray(space.active) < len(space.names))
    places = np.asarray(space.active)[inside]
    names = tuple(space.names[place] for place in places)
    measured = np.any(np.asarray(data.present), axis=(0, 2))
    known, each_std = information(frozen, space, found.unknowns), each_deviations(frozen, space, found.unknowns)
    lower = _Point(np.asarray(space.lower)[places], np.asarray(space.each_lower)[:, None] + np.zeros_like(each_std))
    upper = _Point(np.asarray(space.upper)[places], np.asarray(space.each_upper)[:, None] + np.zeros_like(each_std))
    size = sizes_of(space, found.unknowns)[inside]
    each_size = np.maximum(np.abs(found.physical[1]), np.asarray(space.each_scale)[:, None])
    each_reach = np.minimum(_REACH * each_std, _FRACTION * each_size)

    def physical(at: _Point) -> tuple[Array, Array, Array]:
        shared = np.asarray(found.physical[0]).copy()
        shared[places] = at.shared
        return jnp.asarray(shared), jnp.asarray(at.each), found.physical[2]

    def passed(at: _Point, noise: np.ndarray) -> tuple[float, _Seen]:
        run = run_filter(model, data, space, physical(at), prior, noise, substeps)
        weight = np.diagonal(np.asarray(run.whitener), axis1=1, axis2=2)
        return float(run.log_likelihood.sum()) - space.penalty(physical(at)[0]), _Seen(
            np.asarray(run.innovations), np.moveaxis(weight, -1, 1)
        )

    def rows(at: _Point, noise: np.ndarray) -> Float[np.ndarray, "experiment row column"]:
        reach = _Point(_axes(known, size, at, lower, upper), each_reach)
        return _rows(lambda there: passed(there, noise)[1], at, reach, lower, upper, names)

    def triangles(rows: np.ndarray, at: _Point) -> Float[np.ndarray, "experiment row column"]:
        return _with_constants(_triangular(rows), space, physical(at)[0], places)

    at = _Point(np.asarray(found.physical[0])[places], np.asarray(found.physical[1]))
    noise = Noise(found.noise, found.log_likelihood, found.filtered, None)
    found_rows = rows(at, noise.exponents)
    for _ in range(_STEPS):
        require_time()
        move, promised = _scoring(triangles(found_rows, at), at, lower, upper)
        if promised < _WORTH:
            break
        here = passed(at, noise.exponents)[0]
        for fraction in _SHORTER:
            there = _Point(
                *(np.clip(x + fraction * dx, *ends) for x, dx, *ends in zip(at, move, lower, upper, strict=True))
            )
            if passed(there, noise.exponents)[0] > here:
                break
        else:
            break
        at = there
        noise = fit_noise(model, data, space, physical(at), prior, noise.exponents, substeps)
        progress(f"log-likelihood {noise.log_likelihood:.1f}")
        found_rows = rows(at, noise.exponents)
    of_noise = _by_noise(lambda at_noise: passed(at, at_noise)[1], noise.exponents, measured)
    whole = np.concatenate([found_rows[:, :, :-1], of_noise, found_rows[:, :, -1:]], axis=2)
    blocks = _projected(triangles(whole, at), len(inside), of_noise.shape[2])
    unknowns = _unknowns(found.unknowns, space, inside, at)
    slope = slope_of(space, unknowns)
    columns = np.zeros((*blocks.shape[:2], len(slope) + len(space.each) + 1))
    columns[:, :, inside] = blocks[:, :, : len(inside)] * slope[inside]
    columns[:, :, len(slope) :] = blocks[:, :, len(inside) :]
    columns[:, :, len(slope) : -1] *= each_slope(space, unknowns).T[:, None]
    values = space.physical(unknowns)
    likelihood = noise.log_likelihood - space.penalty(values[0])
    likeliest = Predictor(unknowns, values, noise.exponents, noise.filtered, likelihood)
    return likeliest, columns


def _axes(
    known: Information, size: Float[np.ndarray, " shared"], at: _Point, lower: _Point, upper: _Point
) -> Float[np.ndarray, "shared axis"]:
    """Return the moves of the shared parameters over which the likelihood is differenced, one column each.

    They are principal axes of the information. Parameters that trade with each other move together along one of them: the
    difference of what each does alone, over steps of dry friction, would look like information on what they do together.
    A parameter so near to a bound that a move could cross it moves alone.
    """
    alone = np.minimum(_REACH * np.sqrt(np.diagonal(known.covariance)), _FRACTION * size)
    inner = np.flatnonzero((at.shared - alone > lower.shared) & (at.shared + alone < upper.shared))
    axes = np.diag(alone)
    assert known.parts is not None  # since it comes from the factors of experiments
    relative = known.parts.sum(axis=0)[np.ix_(inner, inner)] * np.outer(size[inner], size[inner])
    shown, directions = np.linalg.eigh(relative)
    step = np.minimum(_REACH / np.sqrt(np.maximum(shown, _NOTHING)), _FRACTION)
    axes[np.ix_(inner, inner)] = size[inner, None] * directions * step
    return axes


def _by_noise(
    seen: Callable[[np.ndarray], _Seen], exponents: Float[np.ndarray, " noise"], measured: np.ndarray
) -> Float[np.ndarray, "experiment row column"]:
    """Return the slopes, as `_rows` does, by random force and torque, and by the noise of every sensor there is."""
    centre = seen(exponents)
    columns = []
    for place in np.flatnonzero(np.concatenate([[True, True], measured])):
        step = np.where(np.arange(len(exponents)) == place, _NOISE_REACH, 0.0)
        columns.append(_along(seen(exponents + step), seen(exponents - step), centre) / (2 * _NOISE_REACH))
    return _by_experiment(columns)


def _projected(
    blocks: Float[np.ndarray, "experiment row every"], shared: int, noise: int
) -> Float[np.ndarray, "experiment row column"]:
    """Return the blocks without the columns of the noise, which is the same in all experiments, after its projection.

    Args:
        blocks: in triangular form, with columns of the noise before the residual.
        shared: number of shared parameters, whose columns come first.
        noise: number of those of the noise.
    """
    own, at = blocks[:, :, shared : -1 - noise], blocks[:, :, -1 - noise : -1]
    # What an experiment's own parameters explain of the noise tells nothing of the shared ones.
    left = np.concatenate([_unexplained(block, mine) for block, mine in zip(blocks, own, strict=True)])
    by_noise = left[:, -1 - noise : -1]
    size = np.maximum(np.sqrt(np.sum(by_noise**2, axis=0)), _NOTHING)
    part = np.linalg.lstsq(by_noise / size, left[:, :shared], rcond=None)[0] / size[:, None]
    return np.concatenate([blocks[:, :, :shared] - at @ part, own, blocks[:, :, -1:]], axis=2)


def _unexplained(
    block: Float[np.ndarray, "row column"], own: Float[np.ndarray, "row own"]
) -> Float[np.ndarray, "row column"]:
    """Return what an experiment's own columns leave of its block."""
    return block - own @ np.linalg.lstsq(own, block, rcond=None)[0] if own.shape[1] else block


def _rows(
    seen: Callable[[_Point], _Seen], at: _Point, reach: _Point, lower: _Point, upper: _Point, names: tuple[str, ...]
) -> Float[np.ndarray, "experiment row column"]:
    """Return slopes and residual of the likelihood by each experiment, by central differences.

    The shared part of the reach holds axes, as `_axes` returns them; that of each experiment, how far each parameter moves.

    The rows are those of the prediction errors and those of the logarithms of their variances, so that the squares of
    the columns are Fisher's information and their products with the last are the slope of the negative log-likelihood.
    """
    centre = seen(at)

    def moved(part: str, row: int, move: float | np.ndarray) -> tuple[_Seen, np.ndarray]:
        """Return the prediction and the part beside, within the bounds; where the model diverges, those of the centre."""
        here, low, high = (getattr(point, part) for point in (at, lower, upper))
        values = here.copy()
        if part == "shared":
            values = np.clip(here + move, low, high)
        else:
            values[row] = np.clip(here[row] + move, low[row], high[row])
        there = seen(at._replace(**{part: values}))
        return (there, values) if np.all(np.isfinite(there.white)) else (centre, here)

    columns = []
    for row, axis in enumerate(reach.shared.T):
        (ahead, far), (behind, near) = (moved("shared", row, sign * axis) for sign in (1, -1))
        width = float((far - near) @ axis / (axis @ axis))  # in lengths of the axis
        if not width > 0:
            raise _diverged(names[np.argmax(np.abs(axis / np.max(np.abs(reach.shared), axis=1)))], np.max(np.abs(axis)))
        columns.append(_along(ahead, behind, centre) / width)
    if columns:
        inverse = np.linalg.inv(reach.shared)
        columns = list(np.moveaxis(np.stack(columns, axis=-1) @ inverse, -1, 0))
    for row, distance in enumerate(reach.each):
        (ahead, far), (behind, near) = (moved("each", row, sign * distance) for sign in (1, -1))
        width = far[row] - near[row]
        if not np.all(width > 0):
            raise _diverged("what each experiment has for itself", float(np.max(distance)))
        columns.append(_along(ahead, behind, centre) / width)
    count = centre.weight > 0
    residual = np.concatenate([centre.white, np.where(count, 1 - centre.white**2, 0.0) / np.sqrt(2)])
    return _by_experiment([*columns, residual])


def _by_experiment(
    columns: Sequence[Float[np.ndarray, "sample output experiment"]],
) -> Float[np.ndarray, "experiment row column"]:
    """Return columns, each of all experiments, as one matrix for each experiment."""
    stacked = np.moveaxis(np.stack(columns, axis=-1), 2, 0)
    return stacked.reshape(len(stacked), -1, stacked.shape[-1])


def _triangular(rows: Float[np.ndarray, "experiment row column"]) -> Float[np.ndarray, "experiment column column"]:
    """Return the triangular factor of each experiment's rows."""
    return np.stack([np.linalg.qr(block, mode="r") for block in rows])


def _diverged(what: str, distance: float) -> DivergedError:
    """Return the error that the model diverges beside the estimate, when a parameter changes by this much."""
    return DivergedError(
        f"The model diverges beside the estimate, when {what} is changed by {distance:.2g}; fix it with model.fix, or begin "
        "with from_model=True at values nearer to the rig."
    )


def _with_constants(
    blocks: Float[np.ndarray, "experiment row column"], space: Space, shared: Array, places: np.ndarray
) -> Float[np.ndarray, "experiment row column"]:
    """Return the blocks with an equal part each of what was measured of constants beforehand."""
    if space.known_std is None:
        return blocks
    weight = 1.0 / (np.asarray(space.known_std)[places] * np.sqrt(len(blocks)))
    rows = np.zeros((len(places), blocks.shape[2]))
    rows[:, : len(places)] = np.diag(weight)
    rows[:, -1] = np.asarray(space.from_known(shared))[places] / np.sqrt(len(blocks))
    return np.stack([np.linalg.qr(np.concatenate([block, rows]), mode="r") for block in blocks])


def _along(ahead: _Seen, behind: _Seen, centre: _Seen) -> Float[np.ndarray, "sample output experiment"]:
    """Stack the change of the standardised prediction errors above that of the logarithms of their variances."""
    count = centre.weight > 0
    errors, logarithms = (
        np.stack([np.where(count, of(side), 0.0) for side in (ahead, behind)])
        for of in (
            lambda side: side.white / np.where(count, side.weight, 1.0),
            lambda side: -np.log(np.where(count, side.weight, 1.0)),
        )
    )
    return np.concatenate([(errors[0] - errors[1]) * centre.weight, np.sqrt(2) * (logarithms[0] - logarithms[1])])


def _scoring(
    blocks: Float[np.ndarray, "experiment row column"], at: _Point, lower: _Point, upper: _Point
) -> tuple[_Point, float]:
    """Return Fisher's step within the bounds, and the gain in log-likelihood that it promises."""
    shared, each, count = len(at.shared), len(at.each), len(blocks)
    whole = np.zeros((shared + each * count + 1,) * 2)
    for k, block in enumerate(blocks):
        place = np.concatenate([np.arange(shared), shared + k + count * np.arange(each), [len(whole) - 1]])
        whole[np.ix_(place, place)] += block.T @ block
    curvature, slope = whole[:-1, :-1], whole[:-1, -1]
    here, low, high = (np.concatenate([p.shared, p.each.ravel()]) for p in (at, lower, upper))
    free = ~((here <= low) & (slope > 0) | (here >= high) & (slope < 0)) & (np.diagonal(curvature) > 0)
    size = np.sqrt(np.diagonal(curvature)[free])
    inner = curvature[np.ix_(free, free)] / np.outer(size, size) + 1e-10 * np.eye(len(size))
    move = np.zeros_like(here)
    move[free] = -np.linalg.solve(inner, slope[free] / size) / size
    move = np.clip(here + move, low, high) - here
    promised = -float(slope @ move + 0.5 * move @ curvature @ move)
    return _Point(move[:shared], move[shared:].reshape(each, count)), promised


def _unknowns(before: Unknowns, space: Space, inside: np.ndarray, at: _Point) -> Unknowns:
    """Return the point as unknowns of the space."""
    places = np.asarray(space.active)[inside]
    bounds = (np.asarray(x)[places] for x in (space.lower, space.upper, space.scale))
    shared = np.asarray(before.shared).copy()
    shared[inside] = to_unconstrained(at.shared, *bounds, inside=_INSIDE)
    of_each = (np.asarray(x)[:, None] for x in (space.each_lower, space.each_upper, space.each_scale))
    each = to_unconstrained(at.each, *of_each, inside=_INSIDE)
    return before._replace(shared=jnp.asarray(shared), each=jnp.asarray(each))
