"""Choice among several refits, and the same once more when all effects are in the model."""

import dataclasses
import math
from collections.abc import Mapping, Sequence

from scipy.stats import chi2

from estimators.diagnosis.evidence import FittedModel
from estimators.diagnosis.laboratory import Laboratory
from estimators.diagnosis.policy import DiagnosisPolicy
from estimators.diagnosis.step import Step
from estimators.misspecification.adequacy import adequacy_tests
from estimators.misspecification.findings import Score
from estimators.validation.vuong_test import vuong_statistic


def gain(before: FittedModel, after: FittedModel) -> float:
    """Return the gain in log-likelihood."""
    return after.log_likelihood - before.log_likelihood


def bic_gain(samples: int, before: FittedModel, after: FittedModel) -> float:
    """Return twice the gain in log-likelihood less the price of the parameters added."""
    return 2 * gain(before, after) - (after.parameters - before.parameters) * math.log(samples)


def held_out_gain(laboratory: Laboratory, before: FittedModel, after: FittedModel, policy: DiagnosisPolicy) -> float:
    """Return the gain in the log-likelihood of experiments that did not take part in estimating the effect.

    NaN if none can tell.
    """
    found = laboratory.held_out(before, after)
    gains = [one for one, known in zip(found.gain, found.known, strict=True) if known >= policy.known]
    return float(sum(gains)) if gains else math.nan


def loose(effect: str, model: FittedModel, policy: DiagnosisPolicy) -> bool:
    """Return whether the data leave a parameter of an added effect free."""
    return not model.looseness.get(effect, 0.0) < policy.loose


def chosen(
    laboratory: Laboratory,
    before: FittedModel,
    tried: Mapping[str, tuple[Score, FittedModel]],
    policy: DiagnosisPolicy,
) -> Step | None:
    """Return the best of the refits as the next step; None if none improves the model.

    Of a law and a simpler one that it contains, which the data cannot tell from it, the simpler is the step. And before an effect
    comes what it presupposes, where that improves the model too: Stribeck friction is what dry friction has more near rest, so that
    alone it leaves none at speed.
    """
    models = {i: model for i, (_, model) in tried.items()}
    gains = {i: bic_gain(laboratory.facts.samples, before, model) for i, model in models.items()}
    held_out = {i: held_out_gain(laboratory, before, model, policy) for i, model in models.items()}
    good = [i for i in models if gains[i] > policy.bic_gain and not held_out[i] <= 0]
    if not good:
        return None
    # One whose shape has run away stands in for a simpler one; the user's own fit would refuse it.
    good = [i for i in good if not loose(i, models[i], policy)] or good
    best = max(good, key=lambda i: gains[i])
    rivals = [i for i in good if i != best and _untold(laboratory, before, models, gains, best, i, policy)]
    if simpler := [i for i in rivals if i in laboratory.facts.effects[best].contains]:
        best = max(simpler, key=lambda i: gains[i])
        rivals = [i for i in good if i != best and _untold(laboratory, before, models, gains, best, i, policy)]
    if first := [i for i in laboratory.facts.effects[best].presupposes if i in good]:
        best = first[0]
        rivals = [i for i in rivals if i != best]
    foremost = sorted(gains, key=lambda i: -gains[i])[: policy.reconsidered]
    asked = {i: tried[i][0] for i in dict.fromkeys((*foremost, best))}
    return Step(
        best, tuple(rivals), 2 * gain(before, models[best]), gains[best], held_out[best], models[best], (), asked
    )


def _untold(
    laboratory: Laboratory,
    before: FittedModel,
    tried: Mapping[str, FittedModel],
    gains: Mapping[str, float],
    best: str,
    other: str,
    policy: DiagnosisPolicy,
) -> bool:
    """Return whether the data cannot tell a candidate from the best."""
    if best in laboratory.facts.effects[other].contains:
        more = tried[other].parameters - tried[best].parameters
        return 2 * gain(tried[best], tried[other]) > float(chi2.isf(policy.nested_level, max(more, 1)))
    if gains[best] - gains[other] < policy.bic_gain:
        return True
    if gain(before, tried[other]) < policy.rival * gain(before, tried[best]):
        return False
    price = 0.5 * (tried[best].parameters - tried[other].parameters) * math.log(laboratory.facts.samples)
    return vuong_statistic(tried[best].by_stretch, tried[other].by_stretch, price) < policy.vuong


def reconsidered(laboratory: Laboratory, base: FittedModel, steps: list[Step], policy: DiagnosisPolicy) -> list[Step]:
    """Compare every earlier effect with those refitted beside it, now that the later ones are there; return the steps.

    What improves a model most while another effect is missing may only mend what that one does. An effect that is not needed
    any more goes, and one that another replaces better goes for it; rivals are those that the data cannot tell from it now.

    Source: stepwise selection with replacement, as in Miller, Subset Selection in Regression (2002), section 3.
    """
    for effect in [step.id for step in steps[:-1]] if policy.reconsidered else []:
        steps = _once_more(laboratory, base, steps, effect, policy)
    return steps


def _once_more(
    laboratory: Laboratory, base: FittedModel, steps: list[Step], effect: str, policy: DiagnosisPolicy
) -> list[Step]:
    """Return the steps with one earlier effect compared with those that were refitted beside it."""
    place = next(i for i, step in enumerate(steps) if step.id == effect)
    if place == len(steps) - 1:
        return steps
    step, now = steps[place], steps[-1].model
    others = [s for i, s in step.asked.items() if i not in now.added]
    laboratory.say(f"{effect} once more")
    before = laboratory.without(now, effect)
    if before is None:  # what the model diverges without is needed
        return steps
    tried = {effect: (step.asked[effect], now)}
    models = laboratory.refits(before, others, step.way)
    tried |= {s.id: (s, models[s.id]) for s in others if s.id in models}
    winner = chosen(laboratory, before, tried, policy)
    if winner is not None and winner.id == effect:
        return [*steps[:place], dataclasses.replace(step, rivals=winner.rivals), *steps[place + 1 :]]
    if winner is None and _may_stand_beside(laboratory, steps, step, policy):
        return steps
    rebuilt = _rebuilt(laboratory, base, steps, place, before, policy)
    return steps if rebuilt is None else rebuilt + ([] if winner is None else [winner])


def _may_stand_beside(laboratory: Laboratory, steps: Sequence[Step], step: Step, policy: DiagnosisPolicy) -> bool:
    """Return whether another step presupposes this one, and the data do not rule it out beside that."""
    known = steps[-1].model.values

    def size(of: Step, deviations: float) -> float:
        found = [known.get(f"{of.id}.{name}", (0.0, 0.0)) for name in of.asked[of.id].amplitudes]
        return max(abs(value) + deviations * std for value, std in found)

    beside = [s for s in steps if step.id in laboratory.facts.effects[s.id].presupposes]
    return any(size(step, 2.0) > policy.presupposed * size(s, 0.0) for s in beside)


def _rebuilt(
    laboratory: Laboratory,
    base: FittedModel,
    steps: Sequence[Step],
    place: int,
    last: FittedModel,
    policy: DiagnosisPolicy,
) -> list[Step] | None:
    """Return the steps without one of them, the refit with all the others being known; None where a model diverges."""
    found = list(steps[:place])
    fits = {steps[-1].id: last}
    for step, later in zip(reversed(steps[place + 1 : -1]), reversed(steps[place + 2 :]), strict=True):
        model = laboratory.without(fits[later.id], later.id)
        if model is None:
            return None
        fits[step.id] = model
    for step in steps[place + 1 :]:
        before = found[-1].model if found else base
        model = fits[step.id]
        left = laboratory.findings(model)
        if left is None:
            return None
        found.append(
            dataclasses.replace(
                step,
                gain=2 * gain(before, model),
                bic_gain=bic_gain(laboratory.facts.samples, before, model),
                held_out_gain=held_out_gain(laboratory, before, model, policy),
                model=model,
                left=adequacy_tests(left, policy.critical),
            )
        )
    return found
