"""Selection of effects by free simulation: where random forces stand in for the physics, predictions one sample ahead mislead.

A sensor with little noise tells the next sample from the last ones alone. A filter with random forces as large as the model's own
then predicts well whatever the model is, and what it finds missing may be anything that smooths. A simulation has no such forces:
what takes nearly all of its error off is a finding.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from estimators.diagnosis.choice import bic_gain, gain, held_out_gain, is_at_its_edge
from estimators.diagnosis.evidence import FittedModel, SimulationError
from estimators.diagnosis.laboratory import Laboratory
from estimators.diagnosis.policy import DiagnosisPolicy
from estimators.diagnosis.selection import Selection, Tried, by_size
from estimators.diagnosis.step import Step
from estimators.inference.simulation_residual import random_forces_are_large
from estimators.misspecification.adequacy import adequacy_tests, rejecting, unconfirmed
from estimators.misspecification.findings import Findings, Score


def selected_by_simulation(
    laboratory: Laboratory, found: Selection, policy: DiagnosisPolicy, *, spoken: bool = False
) -> Selection | None:
    """Select effects by what they take off the simulation's error; None where they do not take off nearly all that is left.

    Asked only where the simulation is far from the data beside random forces, and what is named, or that nothing is, is doubtful;
    and where nothing is named although it follows nothing, and nobody knows the noise, for which predictions may take the motion.

    Args:
        laboratory: that computes, or knows, what is asked.
        found: what predictions one sample ahead select.
        policy: the thresholds.
        spoken: whether a candidate reaches the alarm that predictions can neither confirm nor rule out: then any simulation
            beyond the noise is asked.

    Source: Miller, Subset Selection in Regression (2002), chapter 3, for forward selection.
    """
    facts, named = laboratory.facts, found.named_model(laboratory.facts.samples, policy)
    if not facts.noise_known and not named.added and facts.unfollowed > policy.simulation.unfollowed:
        base = reached = laboratory.simulation(found.base)
    elif spoken and max(found.base.random) >= policy.consequence:
        base = reached = _beyond(laboratory, found.base, policy)
    elif max(found.base.random) < policy.consequence or (base := _far(laboratory, found.base, policy)) is None:
        return None
    else:
        # The simulation with what is named costs a fit, and is asked last.
        reached = _far(laboratory, named, policy) if _is_doubtful(laboratory, found, named, policy) else None
    if base is None or reached is None:
        return None
    laboratory.say("simulations")
    enough = policy.left * min(excess_left(reached.error, base.error, policy), 1.0)
    steps, left, tried = _steps(laboratory, found, base.error, enough, policy)
    simulated = dataclasses.replace(found, steps=steps, simulated=left, tried=found.tried | tried)
    count = simulated.named(laboratory.facts.samples, policy)[1]
    return simulated if count and left[count] <= enough else None


def _far(laboratory: Laboratory, model: FittedModel, policy: DiagnosisPolicy) -> SimulationError | None:
    """Return the error of a model's simulation where that is far from the data, or follows it poorly; None elsewhere.

    Coarse steps of a sensor are noise of which much of the motion may be few times.
    """
    found, limits = laboratory.simulation(model), policy.simulation
    if found is None:
        return None
    poor = any(
        ratio > limits.poor * found.signal[channel] and ratio > limits.beyond**0.5
        for channel, ratio in found.error.items()
    )
    return found if poor or max(found.error.values(), default=0.0) > policy.far else None


def _beyond(laboratory: Laboratory, model: FittedModel, policy: DiagnosisPolicy) -> SimulationError | None:
    """Return the error of a model's simulation where it misses more than the sensors do; None elsewhere."""
    found = laboratory.simulation(model)
    if found is None or max(found.error.values(), default=0.0) ** 2 <= policy.simulation.beyond:
        return None
    return found


def _is_doubtful(laboratory: Laboratory, found: Selection, named: FittedModel, policy: DiagnosisPolicy) -> bool:
    """Return whether a simulation may want other effects than those that are named, by what is known without fitting any.

    They are not doubted where they take the place of the random forces, or each explains most of what any candidate explains of the
    residual that a predictor with next to no random force leaves. Where none is named, it asks for one if a test rejects, if the
    random forces are no small disturbance, or if so little of one experiment could not confirm what is large.
    """
    facts = laboratory.facts
    large = random_forces_are_large(found.base.random, facts.samples_per_radian, policy.simulation)
    if not named.added:
        # Several experiments confirm each other where stretches of time cannot (`second_looks`).
        few = facts.experiments == 1 and unconfirmed(found.findings.scores, facts.seconds, policy.critical)
        return large or bool(rejecting(found.tests) or few)
    if large and not facts.noise_known:
        return True  # what takes their place may be anything that smooths, with whatever is left called noise
    if replaces_random_forces(named, found.base, policy):
        return False
    shown = {s.id: s.statistic for s in by_size(laboratory.quiet_scores(found.base), 0.0)}
    return min(shown.get(i, 0.0) for i in named.added) < policy.static * max(shown.values(), default=0.0)


def replaces_random_forces(model: FittedModel, base: FittedModel, policy: DiagnosisPolicy) -> bool:
    """Return whether what a model has more takes the place of nearly all random forces that another asks for, in power."""
    return sum(x**2 for x in model.random) <= policy.left * sum(x**2 for x in base.random)


def _steps(
    laboratory: Laboratory, found: Selection, base: Mapping[str, float], enough: float, policy: DiagnosisPolicy
) -> tuple[list[Step], tuple[float, ...], Tried]:
    """Return the steps, what is left of the base model's squared error before and after each, and what was fitted.

    They end where enough is explained, or where no candidate explains most of what is left.
    """
    steps: list[Step] = []
    left, tried = [1.0], {}
    now = found.base
    while len(steps) < policy.effects:
        asked = _asked(laboratory, now, policy)
        errors = laboratory.simulation_errors(now, list(asked.values()))
        remaining = {i: excess_left(error, base, policy) for i, error in errors.items()}
        good = [i for i, one in remaining.items() if one <= left[-1] * (1 - policy.static)]
        taken = _taken(laboratory, now, asked, remaining, good, policy)
        several = [taken] if taken is not None else []
        if not several and len(steps) + 2 <= policy.effects:
            several = _pair(laboratory, now, asked, remaining, base, policy)
        for one in several:
            tried[one.effect] = (now, one.model)
            steps.append(
                Step(
                    one.effect, one.rivals, 2 * gain(now, one.model), bic_gain(laboratory.facts.samples, now, one.model),
                    held_out_gain(laboratory, now, one.model, policy), one.model,
                    adequacy_tests(one.after, policy.critical), one.score.amplitudes,
                )
            )  # fmt: skip
            left.append(one.left)
            now = one.model
        if not several or left[-1] <= enough:
            break
    return steps, tuple(left), tried


def _pair(
    laboratory: Laboratory,
    now: FittedModel,
    asked: Mapping[str, Score],
    remaining: Mapping[str, float],
    base: Mapping[str, float],
    policy: DiagnosisPolicy,
) -> list["_Taken"]:
    """Return the candidate that leaves least and another that explains most beside it, where no single one does.

    Dry friction and drag are of opposite curvature beside viscous friction, which takes the mean of what either does.
    """
    if not remaining or not min(remaining.values()) < math.inf:
        return []
    first = min(remaining, key=lambda i: remaining[i])
    model = laboratory.refits(now, [asked[first]], "simulation").get(first)
    after = None if model is None else laboratory.findings(model)
    if model is None or after is None:
        return []
    beside = _asked(laboratory, model, policy)
    errors = laboratory.simulation_errors(model, list(beside.values()))
    together = {i: excess_left(error, base, policy) for i, error in errors.items()}
    good = [i for i, one in together.items() if one <= remaining[first] * (1 - policy.static)]
    second = _taken(laboratory, model, beside, together, good, policy)
    # Few steps rank candidates; the model that was taken has been fitted to its end.
    ended = None if second is None else laboratory.simulation(second.model)
    if second is None or ended is None:
        return []
    left = excess_left(ended.error, base, policy)
    return [_Taken(first, (), model, after, asked[first], remaining[first]), second._replace(left=left)]


def _asked(laboratory: Laboratory, now: FittedModel, policy: DiagnosisPolicy) -> dict[str, Score]:
    """Return the candidates that equations of motion and the simulation's residual speak for most.

    What works by contact is left to trials: when it begins and ends moves by whole samples, which no descent follows. What the
    random forces would hide is asked: a simulation has none.
    """
    by_equations = [s for s in laboratory.equation_scores(now) if s.statistic > policy.bic_gain]
    alarms = [s for s in laboratory.quiet_scores(now) if s.statistic >= policy.alarm]
    contacts = {i for i, traits in laboratory.facts.effects.items() if traits.contact}
    by_size_first = by_size(alarms, math.log(laboratory.facts.samples))
    several = [
        *[s for s in by_equations if s.id not in contacts][: policy.refits],
        *[s for s in by_size_first if s.id not in contacts][: policy.refits],
    ]
    presupposed = {i for s in several for i in laboratory.facts.effects[s.id].presupposes} - {*now.added}
    several += [s for s in laboratory.quiet_scores(now) if s.id in presupposed]
    return {s.id: s for s in reversed(several)}


class _Taken(NamedTuple):
    """A candidate that was taken, what leaves as little, the model with it, its tests, and what is left of the squared error."""

    effect: str
    rivals: tuple[str, ...]
    model: FittedModel
    after: Findings
    score: Score
    left: float


def _taken(
    laboratory: Laboratory,
    now: FittedModel,
    asked: Mapping[str, Score],
    remaining: Mapping[str, float],
    good: Sequence[str],
    policy: DiagnosisPolicy,
) -> _Taken | None:
    """Return the best candidate, its rivals, and the predictor with it that improves on the model; None where there is none."""
    left = list(good)
    while left:
        best, rivals = _best(laboratory, remaining, left, policy)
        model = laboratory.refits(now, [asked[best]], "simulation").get(best)
        # What has become a simpler one leaves its place to that.
        edge = model is not None and is_at_its_edge(laboratory, best, model, policy)
        if edge and any(i in laboratory.facts.effects[best].contains for i in left):
            left.remove(best)
            continue
        after = None if model is None else laboratory.findings(model)
        if model is not None and after is not None and bic_gain(laboratory.facts.samples, now, model) > 0:
            return _Taken(best, tuple(rivals), model, after, asked[best], remaining[best])
        left.remove(best)
    return None


def _best(
    laboratory: Laboratory, remaining: Mapping[str, float], good: Sequence[str], policy: DiagnosisPolicy
) -> tuple[str, list[str]]:
    """Return the candidate that leaves least, or what it contains and leaves as much, or presupposes; and what leaves as much."""

    def alike(one: str) -> list[str]:
        return [i for i in good if remaining[i] <= remaining[one] / (1 - policy.fall) ** 2]

    best = min(good, key=lambda i: remaining[i])
    traits, effects = laboratory.facts.effects[best], laboratory.facts.effects
    simpler = [i for i in good if i in traits.presupposes or (i in traits.contains and i in alike(best))]
    best = min(simpler, key=lambda i: remaining[i], default=best)
    larger = [i for i in good if best in (*effects[i].contains, *effects[i].presupposes)]
    return best, [i for i in alike(best) if i != best and i not in larger]


def excess_left(error: Mapping[str, float], base: Mapping[str, float], policy: DiagnosisPolicy) -> float:
    """Return what is left of the base model's squared error beyond the noise, of all channels; infinite where one is lost."""
    if any(error[c] > max(policy.far, 2 * before) for c, before in base.items()):
        return math.inf
    before = sum(max(e * e - 1, 0.0) for e in base.values())
    left = sum(max(error[c] * error[c] - 1, 0.0) for c in base)
    return left / before if 0 < before < math.inf else 1.0
