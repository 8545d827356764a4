"""Choice among several refits."""

import math
from collections.abc import Mapping, Sequence

from estimators.diagnosis.evidence import FittedModel
from estimators.diagnosis.laboratory import Laboratory
from estimators.diagnosis.policy import DiagnosisPolicy
from estimators.diagnosis.step import Step
from estimators.misspecification.adequacy import adequacy_tests
from estimators.misspecification.findings import Score


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


def chosen(
    laboratory: Laboratory,
    before: FittedModel,
    tried: Mapping[str, tuple[Score, FittedModel]],
    policy: DiagnosisPolicy,
) -> Step | None:
    """Return the best of the refits as the next step; None if none improves the model.

    Of a law and a simpler one that it contains, which the data cannot tell from it or which it has become, the simpler is the step.
    And before an effect comes what it presupposes, where that improves the model too: Stribeck friction is what dry friction has
    more near rest, so that alone it leaves none at speed.
    """
    models = {i: model for i, (_, model) in tried.items()}
    gains = {i: bic_gain(laboratory.facts.samples, before, model) for i, model in models.items()}
    held_out = {i: held_out_gain(laboratory, before, model, policy) for i, model in models.items()}
    good = [i for i in models if gains[i] > policy.bic_gain and not held_out[i] <= 0]
    if not good:
        return None
    # One whose shape has run away stands in for a simpler one; the user's own fit would refuse it.
    good = [i for i in good if not models[i].leaves_free(i)] or good
    best = max(good, key=lambda i: gains[i])
    rivals = _rivals(laboratory, good, gains, best, policy)
    if simpler := [i for i in rivals if i in laboratory.facts.effects[best].contains]:
        best = max(simpler, key=lambda i: gains[i])
        rivals = _rivals(laboratory, good, gains, best, policy)
    at_edge = is_at_its_edge(laboratory, best, models[best], policy)
    if at_edge and (simpler := [i for i in good if i in laboratory.facts.effects[best].contains]):
        best = max(simpler, key=lambda i: gains[i])
        rivals = _rivals(laboratory, good, gains, best, policy)
    if first := [i for i in laboratory.facts.effects[best].presupposes if i in good]:
        best = first[0]
        rivals = [i for i in rivals if i != best]
    return Step(
        best, tuple(rivals), 2 * gain(before, models[best]), gains[best], held_out[best], models[best], (),
        tried[best][0].amplitudes,
    )  # fmt: skip


def is_at_its_edge(laboratory: Laboratory, effect: str, model: FittedModel, policy: DiagnosisPolicy) -> bool:
    """Return whether an added effect has become a simpler one that it contains, by a shape that the data do not show.

    Bristles that yield within a tenth of a sensor's noise (`edge`), or within the first sample after a turn, are dry friction,
    which a simulation follows more smoothly so; what is missing beside it, or random forces, may ask for that.
    """
    edge = laboratory.facts.effects[effect].edge
    if not edge:
        return False
    parameter, channel = edge
    size = abs(model.values.get(f"{effect}.{parameter}", (math.inf, 0.0))[0])
    facts = laboratory.facts
    return size < max(policy.edge * facts.noise.get(channel, 0.0), facts.travel.get(channel, 0.0))


def alone(
    laboratory: Laboratory, first: Step, second: Step, before: FittedModel, single: FittedModel, policy: DiagnosisPolicy
) -> Step | None:
    """Return the second of two steps without the first, which it presupposes, where the data rule that out; None elsewhere.

    Args:
        laboratory: that computes, or knows, what is asked.
        first: what is presupposed.
        second: what presupposes it, added to it.
        before: the model before both.
        single: that with the second effect alone.
        policy: the thresholds.
    """
    if first.id not in laboratory.facts.effects[second.id].presupposes:
        return None

    def size(of: Step, deviations: float) -> float:
        known = [second.model.values.get(f"{of.id}.{name}", (0.0, 0.0)) for name in of.amplitudes]
        return max((abs(value) + deviations * std for value, std in known), default=0.0)

    if size(first, 2.0) > policy.left * size(second, 0.0):
        return None
    left = laboratory.findings(single)
    if left is None:
        return None
    return Step(
        second.id, (), 2 * gain(before, single), bic_gain(laboratory.facts.samples, before, single),
        held_out_gain(laboratory, before, single, policy), single, adequacy_tests(left, policy.critical), second.amplitudes,
    )  # fmt: skip


def _rivals(
    laboratory: Laboratory, good: Sequence[str], gains: Mapping[str, float], best: str, policy: DiagnosisPolicy
) -> list[str]:
    """Return what the data cannot tell from the best; a larger law fits as well as what it contains, and so is no rival of it."""
    effects = laboratory.facts.effects
    near = [i for i in good if i != best and gains[best] - gains[i] < policy.bic_gain]
    return [i for i in near if best not in effects[i].contains]
