"""The likelihood of each experiment about a fit of its own: what one linear step from the common fit does not reach."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from estimators.core.data import CHANNELS
from estimators.core.fit import Fit
from estimators.core.linearisation import Problem, problem_of, rows_at
from estimators.core.results import FAILURES
from estimators.output_error.fit import output_error
from rtac_jax import RTAC
from rtac_jax.measurement import Experiment, Recording
from rtac_jax.prior import Prior

# Standard deviation, as a fraction of a parameter's size, of what the common fit tells an experiment by itself: wide enough for
# any drift that a rig of one build has, narrow enough to hold what the experiment does not show at all.
_ANY_DRIFT = 0.3
# Fraction of a parameter's size by which experiments may differ without consequence. Estimates of combinations are far surer than
# that, and what a model lacks, however little, moves them by many of their deviations.
_TOLERATED = 1e-3
_SURE = 3.0  # deviations of its own from zero, from which the ratio of two values of a parameter means something


class Exact(NamedTuple):
    """Information and gradient of every experiment without what is tolerated, and the number of measured values."""

    information: Float[np.ndarray, "experiment parameter parameter"]
    slope: Float[np.ndarray, "experiment parameter"]
    samples: int


class Curvatures(NamedTuple):
    """The log-likelihood of every experiment to second order, in the parameters' distance from the common fit.

    Attributes:
        information: of each experiment.
        slope: gradient at the common fit, as the second order about the experiment's own fit has it.
        over_noise: what the fit of an experiment by itself leaves at most, over the noise, by channel; empty where none was made.
        median_over_noise: the median of that over the experiments.
        logarithmic: parameters whose distance is the logarithm of a ratio, times their size in the common fit. Data tell the
            ratio of some better than either, and lines of ratios that differ a little meet nowhere but at zero.
        exact: the same where no parameter may be off by itself; None about the common fit.
    """

    information: Float[np.ndarray, "experiment parameter parameter"]
    slope: Float[np.ndarray, "experiment parameter"]
    over_noise: dict[str, float]
    median_over_noise: dict[str, float]
    logarithmic: Bool[np.ndarray, " parameter"]
    exact: Exact | None


def about_common(problem: Problem, names: Sequence[str]) -> Curvatures:
    """Return the likelihood to second order about the common fit itself, with the residual that it left as the noise."""
    rows = rows_at(problem)
    jacobian = rows.jacobian[..., [problem.names.index(name) for name in names]]
    return Curvatures(
        np.einsum("soep,soeq->epq", jacobian, jacobian),
        np.einsum("soep,soe->ep", jacobian, rows.residual),
        {},
        {},
        np.zeros(len(names), dtype=bool),
        None,
    )


def about_own(fit: Fit, problem: Problem, recording: Recording, names: Sequence[str]) -> Curvatures | None:
    """Return the likelihood to second order about a fit of each experiment by itself; None where one cannot be fitted.

    What all of these leave is the noise. Parameters that an experiment does not show stay near the common fit. A robust fit is
    not taken apart so: its weights are of all experiments together.
    """
    if fit.weights:
        return None
    common = np.array([float(np.asarray(fit.model[name])) for name in names])
    space = problem.arguments.space
    # One that is nearly nothing in the common fit may drift all the same, by what is plausible.
    scale = np.array([float(np.asarray(space.scale)[space.names.index(name)]) for name in names])
    size = np.maximum(np.abs(common), scale)
    beginning = _wide(fit.model, names, common, size)
    rest = [e for e in recording if e.kind == "rest"]
    own = []
    for place, experiment in enumerate(problem.experiments):
        model = beginning.with_values(
            {n: np.asarray(fit.model[n])[place : place + 1] for n in fit.model.per_experiment}
        )
        alone = Recording((experiment, *rest), recording.rig)
        try:
            own.append(output_error(model, alone, from_model=True, progress=False))
        except FAILURES:
            return None
    return _pooled(fit, own, problem.experiments, names, common, size)


def _wide(
    model: RTAC, names: Sequence[str], common: Float[np.ndarray, " parameter"], size: Float[np.ndarray, " parameter"]
) -> RTAC:
    """Return the model in which these parameters are free, and known to some extent from the common fit."""
    priors = {n: Prior(value, _ANY_DRIFT * s) for n, value, s in zip(names, common, size, strict=True)}
    held = model.fix(*model.priors)
    return RTAC(held.body, held.effects, held.fixed, held.per_experiment, priors)


def _pooled(
    fit: Fit,
    own: Sequence[Fit],
    experiments: Sequence[Experiment],
    names: Sequence[str],
    common: Float[np.ndarray, " parameter"],
    size: Float[np.ndarray, " parameter"],
) -> Curvatures:
    """Return the curvatures about these fits, in units of the residual that all of them leave together."""
    squares = {c: [f.residual_std[c] ** 2 for f in own if c in f.residual_std] for c in fit.residual_std}
    deviation = {c: float(np.sqrt(np.mean(s))) for c, s in squares.items()}
    levels = np.array([deviation.get(c, 1.0) for c in CHANNELS])
    values = np.array([[float(np.asarray(found.model[name])) for name in names] for found in own])
    # Of what is known by itself in no experiment the logarithm would be of noise.
    std = np.array([[found.parameters[name].std for name in names] for found in own])
    logarithmic = np.all((values * common > 0) & (np.abs(values) > _SURE * std), axis=0)
    ratio = np.where(logarithmic, values / np.where(common == 0, 1.0, common), 1.0)
    away = np.where(logarithmic, -common * np.log(ratio), common - values)
    information, slope, exact, samples = [], [], [], 0
    for place, (experiment, found) in enumerate(zip(experiments, own, strict=True)):
        ended = found.model
        plain = RTAC(ended.body, ended.effects, ended.fixed, ended.per_experiment)
        problem = problem_of(plain, [experiment], levels, substeps=int(found.statistics["substeps"]), start=found.start)
        rows = rows_at(problem)
        jacobian = rows.jacobian[..., [problem.names.index(name) for name in names]] * ratio[place]
        whole = np.einsum("soep,soeq->pq", jacobian, jacobian)
        gradient = np.einsum("soep,soe->p", jacobian, rows.residual) + whole @ away[place]
        exact.append((whole, gradient))
        samples += int(np.sum(np.asarray(problem.arguments.data.present)))
        tolerant, told = _tolerating(whole, gradient, _TOLERATED * size)
        information.append(tolerant)
        slope.append(told)
    left = {c: [f.residual_over_noise.get(c, 0.0) for f in own] for c in deviation if fit.noise.get(c, 0.0) > 0}
    over, median_over_noise = ({c: float(of(x)) for c, x in left.items()} for of in (np.max, np.median))
    known = Exact(np.stack([i for i, _ in exact]), np.stack([s for _, s in exact]), samples)
    return Curvatures(np.stack(information), np.stack(slope), over, median_over_noise, logarithmic, known)


def _tolerating(
    information: Float[np.ndarray, "parameter parameter"],
    slope: Float[np.ndarray, " parameter"],
    tolerated: Float[np.ndarray, " parameter"],
) -> tuple[Float[np.ndarray, "parameter parameter"], Float[np.ndarray, " parameter"]]:
    """Return both as they are where each parameter of this experiment may also be off by so much by itself."""
    size = np.maximum(tolerated, 1e-300)
    values, vectors = np.linalg.eigh(information * np.outer(size, size))
    kept = values > 1e-14 * np.max(values, initial=0.0)
    root = vectors[:, kept] * np.sqrt(values[kept])
    inner = np.linalg.inv(np.eye(int(np.sum(kept))) + root.T @ root)
    score = root @ (inner @ ((vectors[:, kept].T @ (slope * size)) / np.sqrt(values[kept])))
    return (root @ inner @ root.T) / np.outer(size, size), score / size
