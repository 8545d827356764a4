"""Hausman's test of whether estimators of the same physics agree, and what a disagreement means."""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import f as fisher
from scipy.stats import t as student

from estimators.closed_form.table1 import ClosedForm
from estimators.core.correlation import require_level
from estimators.core.data import CHANNELS, motion_of
from estimators.core.deadline import require_time
from estimators.core.fit import Fit
from estimators.core.initial_state import scales_of
from estimators.core.linearisation import at_fit
from estimators.core.piecewise_triangle import LONG
from estimators.core.progress import Progress
from estimators.inference.agreement import Agreement, Disagreement, Vector
from estimators.inference.bootstrap import Shaken, Shuffled, Source
from estimators.inference.estimates import MODAL, Estimator, Result, estimator_of, label_of
from estimators.inference.shaken_simulation import shaken_by
from estimators.inference.simulation_residual import (
    SimulationResidual,
    is_current_noise,
    judged_channels,
    of_unknown_noise,
    simulation_residual,
)
from estimators.linear.fit import LinearModels
from estimators.prediction_error.fit import PredictorFit
from rtac_jax import RTAC, require_configured
from rtac_jax.arguments import checked_arguments
from rtac_jax.measurement import INPUTS, Recording

_DRAWS, _FEW = 80, 32  # replicates, of experiments that are short or long
_SHARED = 1e-3  # fraction of an estimate's own deviation within which two are the same, whatever the model


@checked_arguments
def agreement(
    results: Sequence[Result],
    recording: Recording,
    *,
    labels: Sequence[str] | None = None,
    level: float = 0.01,
    draws: int | None = None,
    block: float = 0.25,
    seed: int = 0,
    progress: bool = True,
) -> Agreement:
    """Compare estimates of the same physics, made by different estimators from the same recording.

    Hausman's idea: two estimators that are both right when the model is right differ only by chance, so a difference that
    is large beside its own standard deviation shows that the model is wrong. Neither estimator need be efficient: the
    distribution of the difference comes from replicates, from each of which every estimator estimates anew (a fit by one
    Gauss-Newton step), so that their common errors cancel, and the bias that an estimator has on such data is taken off. That also
    lets a linear fit take part, whose natural frequency and damping are those of the cart with dry friction and arm; pairs
    with it, and the joint verdict over pairs that depend on each other, reject more rarely than the level says.

    Where `prediction_error_nonlinear` is among the results, a replicate is its model struck by random forces and torques as
    large as it estimated; else it is the first output error's simulation with its residual, in blocks and in random order, as
    the noise, or without an output error the first closed form's, whose starts alone are fitted. The first kind counts
    disturbances of the rig, and so what they hide; the second takes them for a failing.
    An output error that disturbances have led far astray, its residual many times the noise, is better left out.

    Args:
        results: of `least_squares`, `output_error`, `prediction_error_nonlinear` and `prediction_error`; at least one of the
            first three, and a closed form should be made with `weak=True`.
        recording: the one that all were made from.
        labels: of the results, each another.
        level: of the test.
        draws: replicates; more than three times as many as there are quantities. By default 80, or 32 where an experiment is
            long: p-values count that they are few, and a replicate takes seconds there.
        block: duration that stays together when the residual is put in another order [s]; longer than its correlation time.
        seed: of the replicates.
        progress: show how far it is, as `core.progress.Progress` does.

    Raises:
        ValueError: fewer than two results, no fit of the nonlinear model among them, nothing in common, too few draws, or
            labels that are too few or the same.
        RuntimeError: JAX was not configured for double precision.

    Source: Hausman, Econometrica 46 (1978); joint test: Hotelling's T^2; replicates: Kuensch, Ann. Statist. 17 (1989); a
    linear model of what is not linear: Gourieroux, Monfort and Renault, J. Appl. Econometrics 8 (1993), indirect inference.
    """
    require_level(level)
    require_configured()
    several = list(results)
    predictors = [r for r in several if isinstance(r, PredictorFit)]
    fits = [r for r in several if isinstance(r, Fit)]
    if len(several) < 2:
        raise ValueError("agreement holds estimates against each other; give two results or more.")
    if len({id(r) for r in several}) < len(several):
        raise ValueError("one result is given twice, and agrees with itself; give each once.")
    closed = [r for r in several if isinstance(r, ClosedForm)]
    if not fits and not predictors and not closed:
        raise ValueError(
            "agreement needs an estimate of the physics, whose simulation stands for the truth; add est.least_squares's (with "
            "weak=True), est.output_error's or est.prediction_error_nonlinear's result."
        )
    said = tuple(labels) if labels is not None else _labels(several)
    if len(said) != len(several) or len(set(said)) < len(said):
        raise ValueError(f"{len(several)} results need as many labels, each another, not {', '.join(said)}.")
    if predictors:
        source: Source = Shaken.of(predictors[0])
    elif fits:
        source = Shuffled.of(fits[0], recording, block=block)
    else:
        source = Shuffled.of_model(closed[0].model, recording, block=block)
    modal = any(isinstance(r, LinearModels) for r in several)
    for names in {tuple(r.experiments) for r in (*fits, *predictors)} - {
        tuple(one.experiments) for one in (*predictors, *fits)[:1]
    }:
        raise ValueError(
            f"the fits used different experiments, one of them {', '.join(names[:3])}; fit them to the same recording."
        )
    if fitted := [*predictors, *fits]:
        several = [_with_constants_of(fitted[0].model, result) for result in several]
    estimators = [
        estimator_of(result, label, source, recording, modal=modal) for result, label in zip(several, said, strict=True)
    ]
    shared = {
        (a, b): _common(estimators[a], estimators[b]) for a, b in itertools.combinations(range(len(estimators)), 2)
    }
    if not any(shared.values()):
        raise ValueError("the results have no estimated parameter in common.")
    widest = max(len(names) for names in shared.values())
    if draws is None:
        draws = _FEW if max(e.samples for e in recording) >= LONG else _DRAWS
    if draws <= 3 * widest:
        raise ValueError(f"draws is {draws}; {widest} quantities need more than {3 * widest}.")
    names = tuple(dict.fromkeys(n for common in shared.values() for n in common))
    units = tuple(next(w.units[w.names.index(n)] for w in estimators if n in w.names) for n in names)
    random = np.random.default_rng(seed)
    found = np.full((draws, len(estimators), len(names)), np.nan)
    with Progress("agreement", show=progress, unit="replicates", total=draws) as shown:
        for number in range(draws):
            require_time()
            measured = source.draw(random)
            for row, estimator in enumerate(estimators):
                found[number, row] = _in_order(estimator, estimator.again(measured), names)
            shown.step()
    # The estimates by the same step as in the replicates: what an optimiser left undone is large beside the difference of
    # two estimators that almost agree.
    measured = source.measured
    observed = np.array([_in_order(estimator, estimator.again(measured), names) for estimator in estimators])
    values = np.array([_in_order(estimator, estimator.values, names) for estimator in estimators])
    several_pairs = (
        _pair(
            (said[a], said[b]), observed[a] - observed[b], found[:, [a, b]],
            np.array([n in common for n in names]),
        )
        for (a, b), common in shared.items()
        if common
    )  # fmt: skip
    pairs = tuple(pair for pair in several_pairs if pair is not None)
    if not pairs:
        raise ValueError("the results have nothing in common but measured constants, in which they cannot differ.")
    spread = np.std(found, axis=0, ddof=1)
    asks = tuple(estimator.asks for estimator in estimators)
    misfit = {
        label: max(result.residual_std[c] / n for c, n in result.noise.items() if c in result.residual_std)
        for label, result in zip(said, several, strict=True)
        if isinstance(result, Fit)
    }
    simulation = _simulation(fits[0], recording, predictors) if fits else None
    return Agreement(
        names, units, said, asks, values, spread, pairs, level, draws, bool(predictors), misfit, simulation,
        tuple(c for c in (*CHANNELS, *INPUTS) if any(c in {**e.outputs, **e.inputs} for e in recording)),
    )  # fmt: skip


def _with_constants_of(model: RTAC, result: Result) -> Result:
    """Return a closed form about the constants that a fit has estimated.

    It holds them where they were measured, and so all that it estimates is off alike: no failing of the model.
    """
    if not isinstance(result, ClosedForm):
        return result
    values = {name: float(model[name]) for name in model.uncertain if name in result.model.parameters}
    return dataclasses.replace(result, model=result.model.with_values(values))


def _simulation(fit: Fit, recording: Recording, predictors: Sequence[PredictorFit]) -> SimulationResidual:
    """Return what the residual of an output error means, beside the random forces of a predictor if there is one."""
    problem = at_fit(fit, recording)
    data = problem.arguments.data
    rows = {c: CHANNELS.index(c) for c in fit.residual_std}
    random, deviation = (float("nan"), float("nan")), {}
    if predictors:
        left, random = shaken_by(predictors[0], np.asarray(problem.arguments.space.physical(problem.unknowns)[2]))
        deviation = {c: float(left[row]) / fit.noise[c] for c, row in rows.items()}
    signal = motion_of(data)
    scales = scales_of(fit.model, problem.experiments)
    torque = float(np.mean(np.asarray(fit.model["torque_constant"])))  # by an ampere
    return simulation_residual(
        {c: fit.residual_std[c] / fit.noise[c] for c in rows},
        deviation,
        {c: float(signal[row]) / fit.noise[c] for c, row in rows.items()},
        random=random,
        samples_per_radian=1.0 / (scales.frequency * scales.sample_time),
        experiments=len(problem.experiments),
        noise_known=judged_channels(fit.residual_std, recording)[1],
        unknown=of_unknown_noise(fit.residual_std, recording),
        of_the_current=is_current_noise(random, torque * recording.current_noise() / scales.torque),
        tested=False,
    )


def _common(one: Estimator, other: Estimator) -> tuple[str, ...]:
    """Return what both estimate; between two of the physics its parameters, of which the modal quantities are functions."""
    skipped = MODAL if one.physical and other.physical else ()
    return tuple(n for n in one.names if n in other.names and n not in skipped)


def _in_order(estimator: Estimator, values: np.ndarray, names: Sequence[str]) -> np.ndarray:
    at = dict(zip(estimator.names, values, strict=True))
    return np.array([at.get(n, np.nan) for n in names])


def _pair(
    labels: tuple[str, str],
    observed: Vector,
    drawn: Float[np.ndarray, "draw 2 quantity"],
    common: Bool[np.ndarray, " quantity"],
) -> Disagreement | None:
    """Compare two estimators; None where they share all that both estimate.

    Args:
        labels: of the two.
        observed: difference of their estimates.
        drawn: what each estimates from every replicate.
        common: what both estimate.
    """
    places = np.flatnonzero(common)
    first, second = drawn[np.all(np.isfinite(drawn[:, :, places]), axis=(1, 2))][:, :, places].transpose(1, 0, 2)
    # What both take from the same measured constant differs by rounding alone, here as in every replicate, and a test of
    # rounding says nothing.
    kept = first - second
    if len(kept) > 1:
        same = _SHARED * np.maximum(np.std(first, axis=0), np.std(second, axis=0))
        differs = (np.std(kept, axis=0) > same) | (np.abs(observed[places] - np.mean(kept, axis=0)) > same)
        # One that is the same in every replicate, as on a bound that nothing in the data pulls it off, says nothing of it.
        told = np.minimum(np.std(first, axis=0), np.std(second, axis=0)) > 0
        places, kept = places[differs & told], kept[:, differs & told]
    if not len(places):
        return None
    draws, width = kept.shape
    if draws <= 2 * width:
        raise ValueError(
            f"{labels[0]} or {labels[1]} came out in {draws} of {len(drawn)} replicates only, too few to compare them; "
            "raise draws, or compare the others without it (est.agreement)."
        )
    bias = np.mean(kept, axis=0)
    covariance = np.cov(kept, rowvar=False).reshape(width, width) * (1 + 1 / draws)
    std = np.sqrt(np.diagonal(covariance))
    difference = observed[places] - bias
    p_values = 2 * student.sf(np.abs(difference) / std, draws - 1)
    scaled = difference / std
    squared = float(scaled @ np.linalg.solve(covariance / np.outer(std, std), scaled))
    joint = float(fisher.sf(squared * (draws - width) / (width * (draws - 1)), width, draws - width))

    def whole(values: np.ndarray) -> np.ndarray:
        placed = np.full(len(common), np.nan)
        placed[places] = values
        return placed

    return Disagreement(labels, whole(difference), whole(bias), whole(std), whole(p_values), joint)


def _labels(results: Sequence[Result]) -> tuple[str, ...]:
    said = [label_of(r) for r in results]
    return tuple(s if said.count(s) == 1 else f"{s} {said[:i].count(s) + 1}" for i, s in enumerate(said))
