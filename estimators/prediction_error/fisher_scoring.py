"""Fisher scoring to the maximum of the likelihood itself, in which the gains of the filter follow the physics."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from estimators.core.bound_transform import to_unconstrained
from estimators.core.data import Data
from estimators.core.fisher_information import Information, each_slope, sizes_of, slope_of
from estimators.core.parameter_space import Space, Unknowns
from estimators.core.results import DivergedError
from estimators.prediction_error.noise_estimation import Noise, NoiseModel, Predictor, fit_noise, run_filter
from rtac_jax import RTAC
from rtac_jax.simulation import Steps

# The likelihood is differenced over this fraction of a standard deviation to either side: dry friction has steps, which a
# derivative at a point would see, or miss. A parameter that is hardly known moves by a fraction of its size.
_REACH, _SHARE = 0.25, 0.1
# Gain in log-likelihood that a step must promise; less moves nothing by more than a fifth of its deviation.
_WORTH = 0.02
_STEPS = 8
_SHORTER = (1.0, 0.5, 0.25, 0.1)
_INSIDE = 1e-9  # of its scale, how near to a bound a parameter may end


class _Point(NamedTuple):
    """The free shared parameters, and those of each experiment, SI units."""

    shared: Float[np.ndarray, " shared"]
    each: Float[np.ndarray, "each experiment"]


class _Seen(NamedTuple):
    """The prediction errors in units of their standard deviation, and the inverse of that; zero where none count."""

    white: Float[np.ndarray, "sample output experiment"]
    weight: Float[np.ndarray, "sample output experiment"]


def most_likely(
    found: Predictor, model: RTAC, data: Data, space: Space, prior: NoiseModel, known: Information,
    each_std: Float[np.ndarray, "each experiment"], *, substeps: Steps, progress: Callable[[str], None],
) -> tuple[Predictor, Float[np.ndarray, "experiment row column"]]:  # fmt: skip
    """Go on from a fit with frozen gains to the maximum of the likelihood, by Fisher's scoring.

    With the gains frozen, a parameter that changes them, as the gain of a sensor does, seems better known than it is: part of
    its slope is random, and vanishes once the gains follow. On rigs with large random forces its standard
    deviation came out at half of what it was, and the estimate was not the likeliest.

    Args:
        found: the predictor with frozen gains.
        model: of the physics.
        data: of all experiments.
        space: of the parameters.
        prior: of the noise.
        known: of the shared parameters, with frozen gains; it sets the steps of the differences.
        each_std: standard deviations of the parameters of each experiment, for the same use.
        substeps: of the integrator in each sample.
        progress: called with a line of text at each step.

    Returns:
        The predictor there, and triangular factors as `information` takes them. The noise counts as known in these: that
        it is estimated too makes standard deviations up to 7 % larger.

    Raises:
        DivergedError: the model diverges beside the estimate.

    Source: Gupta and Mehra, IEEE Transactions on Automatic Control 19 (1974).
    """
    inside = np.flatnonzero(np.asarray(space.active) < len(space.names))
    places = np.asarray(space.active)[inside]
    lower = _Point(np.asarray(space.lower)[places], np.asarray(space.each_lower)[:, None] + np.zeros_like(each_std))
    upper = _Point(np.asarray(space.upper)[places], np.asarray(space.each_upper)[:, None] + np.zeros_like(each_std))
    shared_std = np.sqrt(np.diagonal(known.covariance))
    reach = _Point(
        np.minimum(_REACH * shared_std, _SHARE * sizes_of(space, found.unknowns)[inside]),
        np.minimum(
            _REACH * each_std, _SHARE * np.maximum(np.abs(found.physical[1]), np.asarray(space.each_scale)[:, None])
        ),
    )

    def physical(at: _Point) -> tuple[Array, Array, Array]:
        shared = np.asarray(found.physical[0]).copy()
        shared[places] = at.shared
        return jnp.asarray(shared), jnp.asarray(at.each), found.physical[2]

    def passed(at: _Point, noise: np.ndarray) -> tuple[float, _Seen]:
        run = run_filter(model, data, space, physical(at), prior, noise, substeps)
        weight = np.diagonal(np.asarray(run.filtered.whitener), axis1=1, axis2=2)
        return -float(run.value) - space.penalty(physical(at)[0]), _Seen(
            np.asarray(run.filtered.innovations), np.moveaxis(weight, -1, 1)
        )

    def triangles(at: _Point, noise: np.ndarray) -> Float[np.ndarray, "experiment row column"]:
        blocks = _triangles(lambda there: passed(there, noise)[1], at, reach, lower, upper, known.names)
        return _with_constants(blocks, space, physical(at)[0], places)

    at = _Point(np.asarray(found.physical[0])[places], np.asarray(found.physical[1]))
    noise = Noise(found.noise, found.log_likelihood, found.filtered)
    blocks = triangles(at, noise.exponents)
    for _ in range(_STEPS):
        move, promised = _scoring(blocks, at, lower, upper)
        if promised < _WORTH:
            break
        here = passed(at, noise.exponents)[0]
        for share in _SHORTER:
            there = _Point(
                *(np.clip(x + share * dx, *ends) for x, dx, *ends in zip(at, move, lower, upper, strict=True))
            )
            if passed(there, noise.exponents)[0] > here:
                break
        else:
            break
        at = there
        noise = fit_noise(model, data, space, physical(at), prior, noise.exponents, substeps)
        progress(f"log-likelihood {noise.log_likelihood:.1f}")
        blocks = triangles(at, noise.exponents)
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


def _triangles(
    seen: Callable[[_Point], _Seen], at: _Point, reach: _Point, lower: _Point, upper: _Point, names: tuple[str, ...]
) -> Float[np.ndarray, "experiment row column"]:
    """Return slopes and residual of the likelihood by each experiment, by central differences, in triangular form.

    The rows are those of the prediction errors and those of the logarithms of their variances, so that the squares of
    the columns are Fisher's information and their products with the last are the slope of the negative log-likelihood.
    """
    centre = seen(at)

    def beside(part: str, row: int, distance: Any) -> tuple[_Seen, Any]:
        """Return the prediction and the value beside, within the bounds; where the model diverges, those of the centre."""
        here, low, high = (getattr(point, part)[row] for point in (at, lower, upper))
        values = getattr(at, part).copy()
        values[row] = np.clip(here + distance, low, high)
        there = seen(at._replace(**{part: values}))
        return (there, values[row]) if np.all(np.isfinite(there.white)) else (centre, here)

    columns = []
    for part in _Point._fields:
        for row, distance in enumerate(getattr(reach, part)):
            (ahead, far), (behind, near) = (beside(part, row, sign * distance) for sign in (1, -1))
            if not np.all(far > near):
                what = names[row] if part == "shared" else "what each experiment has for itself"
                raise DivergedError(
                    f"The model diverges beside the estimate, when {what} is changed by {np.max(distance):.2g}; fix it with "
                    "model.fix, or begin with from_model=True at values nearer to the rig."
                )
            columns.append(_along(ahead, behind, centre) / (far - near))
    count = centre.weight > 0
    residual = np.concatenate([centre.white, np.where(count, 1 - centre.white**2, 0.0) / np.sqrt(2)])
    rows = np.moveaxis(np.stack([*columns, residual], axis=-1), 2, 0)
    return np.stack([np.linalg.qr(block.reshape(-1, block.shape[-1]), mode="r") for block in rows])


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
