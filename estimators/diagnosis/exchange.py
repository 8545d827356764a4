"""Exchange of a selected effect for a runner-up, once the effects that were selected after it are in the model."""

import dataclasses
from collections.abc import Sequence

from estimators.diagnosis.choice import bic_gain, gain, held_out_gain
from estimators.diagnosis.evidence import FittedModel
from estimators.diagnosis.laboratory import Laboratory
from estimators.diagnosis.policy import DiagnosisPolicy
from estimators.diagnosis.selection import Tried, by_size
from estimators.diagnosis.step import Step
from estimators.misspecification.adequacy import adequacy_tests, rejecting

_MOST = 2  # runners-up of a step: two offsets that nothing tells apart


def exchanged(
    laboratory: Laboratory, base: FittedModel, steps: Sequence[Step], tried: Tried, policy: DiagnosisPolicy
) -> list[Step]:
    """Return the steps of a selection, each but the last with what does as well in its place beside those that came after it.

    What is selected first is selected while the others are missing, and may take a part of them: a table's tilt takes the place of
    an offset by what it takes of a ripple. A runner-up that makes the whole likelier takes the place, and what the data cannot tell
    from the best there are its rivals.

    Args:
        laboratory: that computes, or knows, what is asked.
        base: the model before the first step.
        steps: that are named.
        tried: every candidate that was refitted, with the model before it.
        policy: the thresholds.

    Source: sequential replacement; Miller, Subset Selection in Regression (2002), section 3.3.
    """
    found = list(steps)
    for place in range(len(found) - 1):
        before = found[place - 1].model if place else base
        found = _at(laboratory, before, found, place, _near(found, place, before, tried, laboratory, policy), policy)
    return found


def _near(
    steps: Sequence[Step],
    place: int,
    before: FittedModel,
    tried: Tried,
    laboratory: Laboratory,
    policy: DiagnosisPolicy,
) -> list[FittedModel]:
    """Return the refits of a step's runners-up that gained nearly as much as it did, the best first.

    Of laws that contain or presuppose each other the choice was made already, for other reasons than their likelihood.
    """
    samples, named, effects = laboratory.facts.samples, {step.id for step in steps}, laboratory.facts.effects
    now = steps[place].id
    if any(now in effects[step.id].presupposes for step in steps[place + 1 :]):
        return []
    related = {i for i in effects if now in {*effects[i].contains, *effects[i].presupposes}}
    related |= {*effects[now].contains, *effects[now].presupposes}
    gains = {
        i: (bic_gain(samples, before, after), after)
        for i, (origin, after) in tried.items()
        if i not in named | related and origin.number == before.number and not after.leaves_free(i)
    }
    near = [one for one in gains.values() if one[0] >= (1 - policy.close) * steps[place].bic_gain]
    return [after for _, after in sorted(near, key=lambda one: -one[0])[:_MOST]]


def _at(
    laboratory: Laboratory,
    before: FittedModel,
    steps: Sequence[Step],
    place: int,
    near: Sequence[FittedModel],
    policy: DiagnosisPolicy,
) -> list[Step]:
    """Return the steps with the best of the refits in one place, and what the data cannot tell from it as its rivals."""
    now, ids = steps[place], {model.added[-1] for model in near}
    ways = {now.id: list(steps)}
    for model in near:
        other = _continued(laboratory, before, model, steps, place, policy)
        if other is not None:
            ways[model.added[-1]] = other
    whole = {i: bic_gain(laboratory.facts.samples, before, way[-1].model) for i, way in ways.items()}
    best = max(whole, key=lambda i: whole[i])
    rivals = [i for i in ways if i != best and whole[best] - whole[i] < policy.bic_gain]
    # What could not be asked stays a rival.
    unasked = [i for i in now.rivals if i not in ids]
    chosen = ways[best]
    chosen[place] = dataclasses.replace(chosen[place], rivals=(*rivals, *unasked))
    return chosen


def _continued(
    laboratory: Laboratory,
    before: FittedModel,
    model: FittedModel,
    steps: Sequence[Step],
    place: int,
    policy: DiagnosisPolicy,
) -> list[Step] | None:
    """Return the steps with a runner-up in one place and the later ones refitted beside it.

    None where one of these does not improve the model any more, or what is left rejects although it did not.
    """
    found, samples = list(steps[:place]), laboratory.facts.samples
    for step in steps[place:]:
        effect, after = (model.added[-1], model) if step is steps[place] else (step.id, None)
        seen = laboratory.findings(before)
        score = by_size([s for s in seen.scores if s.id == effect], 0.0)[:1] if seen is not None else []
        if after is None and score:
            after = laboratory.refits(before, score, "filter").get(effect)
        left = None if after is None else laboratory.findings(after)
        if after is None or left is None:
            return None
        held_out, worth = held_out_gain(laboratory, before, after, policy), bic_gain(samples, before, after)
        if worth <= policy.bic_gain or held_out <= 0:
            return None
        rivals, amplitudes = (
            (step.rivals, step.amplitudes) if effect == step.id else ((), score[0].amplitudes if score else ())
        )
        step = Step(
            effect,
            rivals,
            2 * gain(before, after),
            worth,
            held_out,
            after,
            adequacy_tests(left, policy.critical),
            amplitudes,
        )
        found.append(step)
        before = after
    return None if rejecting(found[-1].left) and not rejecting(steps[-1].left) else found
