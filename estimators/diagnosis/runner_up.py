"""The runner-up of an effect that was added, where simulations of the held-out experiments ask for it in that effect's place."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from estimators.core.fit import FAR
from estimators.diagnosis.candidate import Candidate
from estimators.diagnosis.diagnosis import Diagnosis
from estimators.diagnosis.model_extension import Added, extended_without, misfit
from estimators.diagnosis.policy import DiagnosisPolicy
from rtac_jax.effects import Effect
from rtac_jax.measurement import Recording
from rtac_jax.parameters import declarations


class Exchange(NamedTuple):
    """An effect that takes another's place.

    Attributes:
        step: the model with it.
        taken: the effect.
        given_up: the one whose place it takes.
    """

    step: Added
    taken: Candidate
    given_up: Candidate


def runner_up(
    last: Added,
    added: Sequence[Candidate],
    diagnoses: Sequence[Diagnosis],
    classes: Mapping[str, type[Effect]],
    train: Recording,
    held_out: Recording,
    *,
    policy: DiagnosisPolicy,
    progress: bool,
) -> Exchange | None:
    """Return the exchange of an added effect for the runner-up that leaves least of the held-out error; None where none is near.

    It takes most of the error off, and leaves the held-out experiments near the data.

    Predictions one sample ahead choose between a lag of the current and one of the encoder by little, and wrongly while other
    effects are still missing beside them. Asked where the simulation of the held-out experiments is off the noise by more
    than could be taken off.

    Args:
        last: the model with all that was added.
        added: the effects that were.
        diagnoses: that named them.
        classes: of the candidates, by id.
        train: the recording that is fitted.
        held_out: the recording that validates.
        policy: the thresholds.
        progress: show bars.
    """
    if max(e.rms_over_noise for e in last.tested.errors.values()) < 1 / (1 - policy.static):
        return None  # what takes most of the error off would be below the noise
    found: list[Exchange] = []
    for given_up, taken in _pairs(last, added, diagnoses, classes, policy)[: policy.refits]:
        effect = classes[taken.id](**{name: p.value for name, p in taken.parameters.items()})
        label = "+ " + ", ".join([*(c.id for c in added if c.id != given_up.id), taken.id])
        step = extended_without(last, [given_up.id], [effect], label, train, held_out, progress=progress)
        if step is not None and misfit(step.tested) <= (1 - policy.static) * misfit(last.tested) and not _far(step):
            found.append(Exchange(step, taken, given_up))
    return min(found, key=lambda one: misfit(one.step.tested), default=None)


def _far(one: Added) -> bool:
    return max(e.rms_over_noise for e in one.tested.errors.values()) > FAR


def _pairs(
    last: Added,
    added: Sequence[Candidate],
    diagnoses: Sequence[Diagnosis],
    classes: Mapping[str, type[Effect]],
    policy: DiagnosisPolicy,
) -> list[tuple[Candidate, Candidate]]:
    """Return the effects that were added with those of the same diagnosis that gained most of what they did, the closest first."""
    found = []
    for diagnosis in diagnoses:
        named = {c.id for c in diagnosis.effects}
        for given_up in (c for c in added if c.id in named):
            found += [
                (given_up, c)
                for c in diagnosis.candidates
                if c.refitted
                and c.id in classes
                and c.id not in last.fit.model
                and set(declarations(classes[c.id])) <= set(c.parameters)
                and c.bic_gain > policy.static * given_up.bic_gain > 0
            ]
    return sorted(found, key=lambda pair: abs(math.log(pair[1].bic_gain / pair[0].bic_gain)))
