"""Rival hypotheses: effects that a diagnosis could not tell apart, with the model and noise to tell them apart with."""

import dataclasses
from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from estimators.core.data import Data, moving, pieces
from estimators.core.fit import Fit
from estimators.core.initial_state import scales_of, space_of, without_angle
from estimators.core.progress import Progress
from estimators.core.sensor_noise import noise_levels
from estimators.diagnosis.candidate import Candidate
from estimators.diagnosis.diagnosis import Diagnosis
from estimators.prediction_error.noise_estimation import fit_trusted
from estimators.prediction_error.noise_model import NoiseModel
from rtac_jax import RTAC
from rtac_jax.effects import CATALOGUE, Effect
from rtac_jax.effects.one_sided_spring import GROSS
from rtac_jax.effects.wrong_constant import WRONG_CONSTANTS
from rtac_jax.measurement import Recording
from rtac_jax.parameters import declarations

_RIVALS = 2  # nearest candidates that an effect is told from where the diagnosis found no ambiguity
_BESIDE: dict[str, type[Effect]] = {c.id: c for c in WRONG_CONSTANTS.values()} | GROSS
MODEL = "the model alone"
"""What a single effect is told from."""


@dataclasses.dataclass(frozen=True)
class Contest:
    """The hypotheses to be told apart.

    Attributes:
        effects: ids.
        pairs: every effect against every other, one that was named without doubt against each of its rivals, or a single one
            against `MODEL`.
        instances: of each effect: the one at its estimate, or all shapes, as large as the recording could hide,
            where it was not fitted.
        truth: the model with the best of the effects, fitted to the recording.
        base: the same without any of them.
        process: spectral densities of random force [N^2 s] and random torque [(N m)^2 s] that the data show with `truth`.
        sensor_variance: of each output, SI units squared.
        substeps: Runge-Kutta steps per sample.
        start: states at the start of the experiments of the recording, where the first samples do not show them.
    """

    effects: tuple[str, ...]
    pairs: tuple[tuple[str, str], ...]
    instances: Mapping[str, tuple[Effect, ...]]
    truth: RTAC
    base: RTAC
    process: tuple[float, float]
    sensor_variance: Float[Array, " output"]
    substeps: int
    start: Mapping[str, np.ndarray]


def contest_of(
    fit: Fit,
    recording: Recording,
    found: Diagnosis,
    *,
    between: Sequence[str] | None,
    candidates: Sequence[type[Effect]] | None,
    progress: bool,
) -> Contest:
    """Choose the effects and fit the best of them together with the base model.

    Raises:
        ValueError: nothing is to be told apart, or an effect is unknown.
    """
    effects = _chosen(found, between)
    # What was named without doubt is told from its rivals, not these from each other.
    sure = effects[0] if between is None and found.verdict == "missing" else None
    classes = {c.id: c for c in candidates} if candidates is not None else CATALOGUE | _BESIDE
    known = {c.id: c for c in found.candidates}
    experiments = pieces(moving(recording))
    scales = scales_of(fit.model, experiments)
    instances: dict[str, tuple[Effect, ...]] = {}
    for name in effects:
        if name in known and name not in classes:
            raise ValueError(f"candidates: {name} is not among them; give the candidates that the diagnosis was given.")
        if name not in known:
            raise ValueError(
                f"between: {name!r} is no candidate of the diagnosis; choose among {', '.join(c for c in known if c in classes)}."
            )
        estimate = {n: p.value for n, p in known[name].parameters.items()}
        possible = (_hidden(instance, known[name], found.policy.alarm) for instance in classes[name].candidates(scales))
        if not estimate and not known[name].testable:
            raise ValueError(f"between: nothing in the recording could show {name} at a plausible size; leave it out.")
        instances[name] = (classes[name](**estimate),) if estimate else tuple(possible)
    others = [effect for effect in found.additions if effect.id not in effects]
    best = next((e.id for e in found.additions if e.id in effects), None)
    if best is None:
        fitted = [known[name] for name in effects if known[name].refitted]
        best = max(fitted, key=lambda c: c.bic_gain).id if fitted else None
    truth = fit.model
    for effect in [*others, *(instances[best][:1] if best else ())]:
        truth = truth + effect

    start = {e.name: fit.start[e.name][:4] for e in without_angle(experiments)}
    free = [name for name in truth.free if name not in truth.per_experiment]
    space = space_of(truth, experiments, free=free, start=start)
    prior = NoiseModel.of(dict(noise_levels(recording.experiments)), recording.experiments, scales, space)
    substeps = int(fit.statistics["substeps"])
    with Progress("next experiment", show=progress) as shown:
        predictor, _ = fit_trusted(
            truth,
            Data.of(experiments),
            space,
            prior,
            substeps=jnp.asarray(substeps),
            progress=shown.step,
        )
    shared, each, _ = (np.asarray(part) for part in predictor.physical)
    truth = truth.with_values(dict(zip(space.names, shared, strict=True)) | dict(zip(space.each, each, strict=True)))
    if best is not None:
        instances[best] = tuple(effect for effect in truth.effects if effect.id == best)
    densities = np.exp(predictor.noise[:2]) * np.array([prior.force, prior.torque]) ** 2 * prior.interval
    present = [name for name in effects if name in truth]
    return Contest(
        effects=effects,
        pairs=tuple((i, j) for i in effects for j in effects if i != j and sure in (None, i, j))
        or ((effects[0], MODEL),),
        instances=instances,
        truth=truth,
        base=truth.without(*present),
        process=(float(densities[0]), float(densities[1])),
        sensor_variance=jnp.asarray(np.exp(predictor.noise[2:]) * prior.sensor**2),
        substeps=substeps,
        start=start,
    )


def _hidden(instance: Effect, known: Candidate, alarm: float) -> Effect:
    """Return an instance of plausible size, made as small as the recording says: larger it would have been seen."""
    names = type(instance).amplitudes()
    values = {n: float(np.asarray(getattr(instance, n))) for n in declarations(instance)}
    largest = known.detection_limit * np.sqrt(max(known.score / alarm, 1.0))
    declared = declarations(instance)
    alike = [n for n in names if declared[n].unit == known.unit]
    fraction = min(1.0, largest / max(abs(values[n]) for n in alike))
    return type(instance)(**{n: value * (fraction if n in names else 1.0) for n, value in values.items()})


def _chosen(found: Diagnosis, between: Sequence[str] | None) -> tuple[str, ...]:
    if between is not None:
        if isinstance(between, str):
            raise ValueError(f"between: is the text {between!r}; give a list of names.")
        if not between:
            raise ValueError("between: is empty; name the effects to tell apart.")
        return tuple(dict.fromkeys(between))
    open_to_doubt = next((c for c in found.effects if c.confusable_with), None)
    if open_to_doubt is not None:
        return (open_to_doubt.id, *open_to_doubt.confusable_with)
    if found.verdict == "adequate":
        raise ValueError(
            "nothing is to be told apart: the diagnosis says that nothing is missing; name effects (between)."
        )
    accepted = {c.id for c in found.effects}
    rivals: list[Candidate] = sorted(
        (c for c in found.candidates if c.id not in accepted and (c.refitted or c.testable)),
        key=lambda c: (c.refitted, c.bic_gain, c.score),
        reverse=True,
    )
    return tuple(c.id for c in [*found.effects[:1], *rivals[: _RIVALS + (not accepted)]])
