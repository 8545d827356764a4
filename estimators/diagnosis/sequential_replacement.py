"""Replacement of the effect that was selected first, once the effects that were selected after it are in the model."""

import dataclasses
import math
from collections.abc import Sequence

from estimators.diagnosis.choice import bic_gain, gain, held_out_gain, is_at_its_edge
from estimators.diagnosis.evidence import FittedModel
from estimators.diagnosis.laboratory import Laboratory
from estimators.diagnosis.policy import SURE, DiagnosisPolicy
from estimators.diagnosis.removed_error import named
from estimators.diagnosis.selection import Tried, by_size
from estimators.diagnosis.step import Step
from estimators.misspecification.adequacy import AdequacyTest, adequacy_tests, rejecting
from estimators.misspecification.findings import Score


def with_replacement(
    laboratory: Laboratory,
    base: FittedModel,
    steps: Sequence[Step],
    tests: Sequence[AdequacyTest],
    tried: Tried,
    policy: DiagnosisPolicy,
) -> list[Step]:
    """Return the steps of a selection with what does better in the place of the first, beside those that came after it.

    What is selected first is selected while the others are missing, and may take a part of them: a table's tilt takes the place of
    an offset by what it takes of a ripple. A candidate that makes the whole likelier replaces it, and what the data cannot tell
    from the best there are its rivals.

    Args:
        laboratory: that computes, or knows, what is asked.
        base: the model before the first step.
        steps: that are named, two or more.
        tests: of the base model.
        tried: every candidate that was refitted, with the model before it.
        policy: the thresholds.

    Source: sequential replacement; Miller, Subset Selection in Regression (2002), section 3.3.
    """
    first, samples = steps[0], laboratory.facts.samples
    sequences = {first.id: list(steps)}
    answered: set[str] = set()
    for model in _candidates(laboratory, base, steps, tried, policy):
        laboratory.say(f"{model.added[-1]} in the place of {first.id}")
        sequence = _continued(laboratory, base, model, steps, steps, policy)
        if sequence is None:
            continue
        answered.add(model.added[-1])
        if sequence and named(sequence, tests, samples, policy)[1] == len(steps):
            sequences[model.added[-1]] = sequence
    if set(sequences).intersection(_became(laboratory, steps, policy)):
        # It is one of these by now, whatever it gains: bristles that beside the later effects yield by nothing are dry friction.
        del sequences[first.id]
    gains = {effect: bic_gain(samples, base, sequence[-1].model) for effect, sequence in sequences.items()}
    best = max(gains, key=lambda effect: gains[effect])
    alike = [effect for effect in sequences if effect != best and gains[best] - gains[effect] < policy.bic_gain]
    # What could not be asked stays a rival.
    unanswered = [effect for effect in first.rivals if effect not in answered]
    late = tuple(effect for effect in unanswered if effect in first.late)
    begin = dataclasses.replace(sequences[best][0], rivals=(*alike, *unanswered), late=late)
    return [begin, *sequences[best][1:]]


def without_superseded(
    laboratory: Laboratory,
    base: FittedModel,
    steps: Sequence[Step],
    policy: DiagnosisPolicy,
) -> list[Step]:
    """Return the steps without those of which later ones leave nothing; all of them where each is still needed.

    A lag of the encoder is selected while that of the current is missing, which explains all of it once dry friction is there.

    Args:
        laboratory: that computes, or knows, what is asked.
        base: the model before the first step.
        steps: that are named, two or more.
        policy: the thresholds.

    Source: backward elimination; Efroymson, in Mathematical Methods for Digital Computers (1960); Miller, Subset Selection in
    Regression (2002), section 3.2.
    """
    effects, samples = laboratory.facts.effects, laboratory.facts.samples
    for step in steps[:-1]:
        others = [one for one in steps if one is not step]
        needed = any(step.id in effects[one.id].presupposes for one in others)
        if needed or _is_told(step, steps[-1].model):
            continue
        model = _refitted(laboratory, base, others[0].id)
        sequence = None if model is None else _continued(laboratory, base, model, others, steps, policy)
        if sequence and bic_gain(samples, base, sequence[-1].model) >= bic_gain(samples, base, steps[-1].model):
            return [dataclasses.replace(new, rivals=old.rivals) for new, old in zip(sequence, others, strict=True)]
    return list(steps)


def _is_told(step: Step, last: FittedModel) -> bool:
    """Return whether a model shows an effect: any of its sizes by more than two standard deviations, as far as these are known."""
    sizes = [last.values.get(f"{step.id}.{name}", (math.inf, 0.0)) for name in step.amplitudes]
    return not sizes or any(abs(value) > SURE * std for value, std in sizes)


def _candidates(
    laboratory: Laboratory, base: FittedModel, steps: Sequence[Step], tried: Tried, policy: DiagnosisPolicy
) -> list[FittedModel]:
    """Return the refits of the base model with candidates that gained nearly as much as the first step, the best first.

    Of laws that contain or presuppose each other the choice was made already, for other reasons than their likelihood; but the
    first may have become the simpler one since.
    """
    effects, first, samples = laboratory.facts.effects, steps[0], laboratory.facts.samples
    later = {step.id for step in steps[1:]}
    if any(first.id in effects[effect].presupposes for effect in later):
        return []
    gains = {
        effect: bic_gain(samples, base, after)
        for effect, (before, after) in tried.items()
        if effect not in {first.id, *later} and before.number == base.number and not after.leaves_free(effect)
        and not is_at_its_edge(laboratory, effect, after, policy) and set(effects[effect].presupposes) <= later
    }  # fmt: skip
    near = [effect for effect in gains if gains[effect] >= (1 - policy.close) * first.bic_gain]
    simplest = [effect for effect in near if not set(effects[effect].contains) & {first.id, *near}]
    became = [effect for effect in _became(laboratory, steps, policy) if effect in gains]
    apart = [effect for effect in simplest if effect not in effects[first.id].contains]
    ordered = [*became, *sorted(apart, key=lambda effect: -gains[effect])]
    return [tried[effect][1] for effect in ordered[: policy.refits]]


def _became(laboratory: Laboratory, steps: Sequence[Step], policy: DiagnosisPolicy) -> tuple[str, ...]:
    """Return the simpler laws of which the first effect is one beside all later ones; none where it is not at its edge there."""
    first = steps[0].id
    at_edge = is_at_its_edge(laboratory, first, steps[-1].model, policy)
    return laboratory.facts.effects[first].contains if at_edge else ()


def _continued(
    laboratory: Laboratory,
    base: FittedModel,
    model: FittedModel,
    steps: Sequence[Step],
    known: Sequence[Step],
    policy: DiagnosisPolicy,
) -> list[Step] | None:
    """Return the steps with a candidate in the first place and the later ones refitted beside it; `known` are those named so far.

    An empty list where one of these does not improve the model, or where what is left rejects although it did not; None where an
    answer is missing, as a refit that was broken off.
    """
    sequence: list[Step] = []
    before = base
    for number, step in enumerate(steps):
        effect = step.id if number else model.added[-1]
        score = _score(laboratory, before, effect)
        after = _refitted(laboratory, before, effect) if number else model
        left = None if after is None else laboratory.findings(after)
        if after is None or left is None:
            return None
        held_out = held_out_gain(laboratory, before, after, policy)
        improvement = bic_gain(laboratory.facts.samples, before, after)
        if improvement <= policy.bic_gain or held_out <= 0:
            return []
        rivals, amplitudes = (step.rivals, step.amplitudes) if number else ((), score[0].amplitudes if score else ())
        tests = adequacy_tests(left, policy.critical)
        sequence.append(Step(effect, rivals, 2 * gain(before, after), improvement, held_out, after, tests, amplitudes))
        before = after
    return [] if rejecting(sequence[-1].left) and not rejecting(known[-1].left) else sequence


def _refitted(laboratory: Laboratory, before: FittedModel, effect: str) -> FittedModel | None:
    """Return a model with an effect, from the shape that its tests speak for most; None where that is not known."""
    score = _score(laboratory, before, effect)
    return laboratory.refits(before, score, "filter").get(effect) if score else None


def _score(laboratory: Laboratory, before: FittedModel, effect: str) -> list[Score]:
    """Return the largest score of an effect beside a model; none where it has none."""
    found = laboratory.findings(before)
    return by_size([s for s in found.scores if s.id == effect], 0.0)[:1] if found is not None else []
