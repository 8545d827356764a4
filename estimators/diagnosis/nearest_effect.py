"""The effect that comes nearest where none explains all that is missing: kept if it serves held-out experiments."""

from collections.abc import Mapping

from estimators.diagnosis.candidate import Candidate
from estimators.diagnosis.diagnosis import Diagnosis
from estimators.diagnosis.model_extension import Added, add_effects, is_sure, misfit
from estimators.diagnosis.policy import STANDARD, DiagnosisPolicy
from rtac_jax.effects import Effect
from rtac_jax.measurement import Recording
from rtac_jax.parameters import declarations


def nearest_of(found: Diagnosis) -> tuple[Candidate, ...]:
    """Return what comes nearest: what takes most of the simulation's squared error off, and what removes most of the misfit.

    Of the latter the first of those that explain most of it; none where none does.
    """
    explaining = sorted((c for c in found.candidates if c.explains_most), key=lambda c: -c.error_reduction)[:1]
    known = {c.id for c in found.nearest_simulated}
    return (*found.nearest_simulated, *(c for c in explaining if c.id not in known))


def add_nearest(
    last: Added,
    found: Diagnosis,
    classes: Mapping[str, type[Effect]],
    train: Recording,
    held_out: Recording,
    *,
    policy: DiagnosisPolicy = STANDARD,
    progress: bool,
) -> tuple[Added, Candidate] | None:
    """Return the model with the nearest effect, if the error of the held-out experiments clearly falls with it.

    Of several that with which it falls most.

    Args:
        last: the model without it, against the held-out experiments.
        found: the diagnosis of that model, with a verdict that is unknown.
        classes: of the candidates, by id.
        train: the recording that is fitted.
        held_out: the recording that validates.
        policy: the thresholds by which it is kept.
        progress: show bars.
    """
    several = nearest_of(found)[: policy.refits]
    served = [_with_one(last, near, classes, train, held_out, policy, progress=progress) for near in several]
    return min((one for one in served if one is not None), key=lambda one: misfit(one[0].tested), default=None)


def _with_one(
    last: Added,
    nearest: Candidate,
    classes: Mapping[str, type[Effect]],
    train: Recording,
    held_out: Recording,
    policy: DiagnosisPolicy,
    *,
    progress: bool,
) -> tuple[Added, Candidate] | None:
    if nearest.id not in classes or nearest.id in last.fit.model:
        return None
    cls = classes[nearest.id]
    if not set(declarations(cls)) <= set(nearest.parameters):
        return None
    effect = cls(**{name: nearest.parameters[name].value for name in declarations(cls)})
    label = f"+ {nearest.id}" if last.tested.label == "base" else f"{last.tested.label}, {nearest.id}"
    step = add_effects(
        last.fit,
        last.tested,
        [effect],
        label,
        train,
        held_out,
        deviations={f"{nearest.id}.{field}": std for field, std in nearest.deviations.items()},
        policy=policy,
        progress=progress,
    )
    if isinstance(step, str) or misfit(step.tested) > (1 - policy.fall) * misfit(last.tested):
        return None
    return (step, nearest) if is_sure(step.fit, nearest.id) else None
