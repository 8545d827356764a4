"""Stepwise selection of effects that improve a model, and second looks where these leave the misfit unknown."""

import dataclasses
import math
from collections.abc import Sequence

from estimators.diagnosis.asked_beside import beside, presupposed, resembling
from estimators.diagnosis.choice import alone, chosen, gain
from estimators.diagnosis.evidence import FittedModel
from estimators.diagnosis.laboratory import Laboratory, Way
from estimators.diagnosis.policy import DiagnosisPolicy
from estimators.diagnosis.removed_error import named
from estimators.diagnosis.selection import Selection, Tried, by_size, nameable
from estimators.diagnosis.sequential_replacement import with_replacement, without_superseded
from estimators.diagnosis.simulation_selection import replaces_random_forces, selected_by_simulation
from estimators.diagnosis.step import Step
from estimators.inference.simulation_residual import follows_nothing
from estimators.misspecification.adequacy import (
    adequacy_tests,
    alarming,
    excess_of,
    overshadowing,
    rejecting,
    significant,
    suspects,
)
from estimators.misspecification.findings import Findings, Score


@dataclasses.dataclass(frozen=True)
class _Look:
    """The candidates of a first step, rejecting or not, in the order of how strongly they are suspected.

    Attributes:
        ranked: those to be refitted, all but the first and what is near it only if the first leaves something.
        near: those among them that are refitted together with the first.
        way: to refit them.
        least: gain that the first step must have, or none is taken.
        single: whether the first step alone is wanted, so that it is not judged beside later ones.
        known: the first step of another look: where this one takes it, too, and gains no more, what follows is known.
    """

    ranked: Sequence[Score]
    near: Sequence[Score]
    way: Way
    least: float = 0.0
    single: bool = False
    known: Step | None = None

    def repeats(self, step: Step, policy: DiagnosisPolicy) -> bool:
        """Return whether what follows a first step is known."""
        known = self.known
        return known is not None and step.id == known.id and step.gain <= known.gain + policy.bic_gain


def select(laboratory: Laboratory, policy: DiagnosisPolicy, *, thorough: bool, laws_first: bool = False) -> Selection:
    """Select the effects that improve the base model, with coloured noise where the data ask for it.

    Args:
        laboratory: that computes, or knows, what is asked.
        policy: the thresholds.
        thorough: look again at what raised no alarm, where the misfit would stay unknown.
        laws_first: look for nothing more where a force of one variable explains it (`is_static`).
    """
    if gross(laboratory, policy):
        by_equations = explaining_equations(laboratory, policy)
        if by_equations.named(laboratory.facts.samples, policy)[1]:
            return by_equations
    found = _outdone(laboratory, policy) or _selected(laboratory, laboratory.base, policy)
    if laws_first and is_static(laboratory, found, policy):
        return dataclasses.replace(found, static=True)
    simulated = selected_by_simulation(laboratory, found, policy)
    if simulated is not None:
        return simulated
    if found.base.number == laboratory.base.number and rejecting(found.tests) and not laboratory.facts.rest:
        # Noise that wanders makes almost every effect look useful; without rest records the likelihood must say.
        laboratory.say("colour of the noise")
        final = found.steps[-1].model if found.steps else found.base
        coloured = laboratory.coloured(beside=final)
        if coloured is not None and coloured.log_likelihood > final.log_likelihood:
            found = _selected(laboratory, coloured, policy)
    return second_looks(laboratory, found, policy) if thorough else found


def _outdone(laboratory: Laboratory, policy: DiagnosisPolicy) -> Selection | None:
    """Return the selection with coloured noise where that gains as much as two effects like the best one would; None elsewhere.

    Then no effect beside white noise is worth a search: the first is the best of all, and the next add little to it.
    """
    base, facts = laboratory.base, laboratory.facts
    findings = laboratory.findings(base) or Findings()
    if facts.rest or not rejecting(adequacy_tests(findings, policy.critical)):
        return None
    first = _next_step(laboratory, base, findings, {}, policy, None)
    if first is None or not rejecting(first.left):
        return None
    laboratory.say("colour of the noise")
    coloured = laboratory.coloured(beside=first.model)
    if coloured is None or gain(base, coloured) <= 2 * gain(base, first.model):
        return None
    return _selected(laboratory, coloured, policy)


def is_static(laboratory: Laboratory, found: Selection, policy: DiagnosisPolicy) -> bool:
    """Return whether a force of one variable explains nearly all that is missing, no candidate does, and none half of it unasked.

    Where the noise is not known it may be what is missing.
    """
    facts, scores = laboratory.facts, found.findings.scores
    if not facts.rest or found.named(facts.samples, policy)[0] != "unknown":
        return False
    test = next((test for test in rejecting(found.tests) if test.test == "static force"), None)
    several = () if test is None else significant(found.findings.curves, test.level)
    most = max((curve.excess for curve in several), default=0.0)
    speaking = alarming(scores, policy.critical) or suspects(scores, found.tests, policy.critical)
    asked = all(s.id in found.tried for s in speaking if s.statistic >= policy.static * most)
    return asked and 0.0 < (1.0 - policy.left) * excess_of(found.tests) <= most


def gross(laboratory: Laboratory, policy: DiagnosisPolicy) -> bool:
    """Return whether the fit that is diagnosed follows nothing."""
    base, facts = laboratory.base, laboratory.facts
    return follows_nothing(facts.unfollowed, base.random, facts.samples_per_radian, policy.simulation)


def explaining_equations(laboratory: Laboratory, policy: DiagnosisPolicy) -> Selection:
    """Select effects by what they take off the equation error, which needs no fit of the base model.

    The first step tries what a forward selection takes, and what comes next; what is then left shows in the innovations.
    """
    laboratory.say("equations of motion")
    findings = laboratory.findings(laboratory.base) or Findings()
    tests = adequacy_tests(findings, policy.critical)
    ranked = [s for s in laboratory.equation_scores(laboratory.base) if s.statistic > policy.bic_gain][: policy.refits]
    # What innovations show of something else, as of an input that is declared wrongly, may be more than all that.
    large = by_size(nameable(laboratory.facts, alarming(findings.scores, policy.critical)), 0.0)
    least = large[0].statistic if large else 0.0
    look = _Look(ranked, _near(ranked, policy.close) if ranked else [], "equations", least)
    return Selection(
        laboratory.base, findings, tests, *improvements(laboratory, laboratory.base, findings, policy, look)
    )


def _selected(laboratory: Laboratory, base: FittedModel, policy: DiagnosisPolicy) -> Selection:
    findings = laboratory.findings(base) or Findings()
    tests = adequacy_tests(findings, policy.critical)
    return Selection(base, findings, tests, *improvements(laboratory, base, findings, policy))


def _consistency(s: Score) -> float:
    return -math.log(max(s.p_value, 1e-300))


def _near(ranked: Sequence[Score], close: float) -> list[Score]:
    return [s for s in ranked[1:] if s.statistic > (1 - close) * ranked[0].statistic]


def unalarmed(laboratory: Laboratory, found: Selection, policy: DiagnosisPolicy) -> _Look:
    """Return candidates that are large, but act at a few instants only."""
    return _largest(laboratory, suspects(found.findings.scores, found.tests, policy.critical), policy)


def _largest(laboratory: Laboratory, several: Sequence[Score], policy: DiagnosisPolicy) -> _Look:
    ranked = by_size(nameable(laboratory.facts, several), math.log(laboratory.facts.samples))[: policy.refits]
    return _Look(ranked, _near(ranked, policy.close), "filter")


def hidden(laboratory: Laboratory, found: Selection, policy: DiagnosisPolicy) -> _Look:
    """Return candidates that random forces of the predictor may hide.

    Where the innovations are far from white, what is alike in every second tells more than what is large. What the predictor
    could not show at all beside its random forces is among them, and the largest of it is tried: it may be what they stand for.
    """
    large = by_size(laboratory.quiet_scores(found.base), math.log(laboratory.facts.samples))
    alike = sorted(large, key=_consistency, reverse=True)
    ranked = list({s.id: s for s in (*alike[:1], *large[:1], *_masked(laboratory, large))}.values())
    return _Look(ranked, [], "thorough")


def _masked(laboratory: Laboratory, large: Sequence[Score]) -> list[Score]:
    """Return those of several candidates that no filter shows beside its random forces, of what is no contact the first."""
    effects, untestable = laboratory.facts.effects, set(laboratory.facts.untestable)
    # What works by contact shows nowhere until the filter follows it.
    contacts = [s for s in large if effects[s.id].contact]
    return [*contacts, *[s for s in large if s.id in untestable and s not in contacts][:1]]


def second_looks(laboratory: Laboratory, found: Selection, policy: DiagnosisPolicy) -> Selection:
    """Return the selection or, where it leaves the misfit unknown, another that explains it, with all that was tried.

    And where it names nothing, another of what every experiment confirms, or of what random forces stood for.
    """
    verdict = found.named(laboratory.facts.samples, policy)[0]
    if verdict == "adequate":
        found = confirmed(laboratory, found, policy)
        found = found if found.steps else behind_random_forces(laboratory, found, policy)
        return found if found.steps else what_simulations_say(laboratory, found, policy)
    if verdict != "unknown":
        return found
    for look in (unalarmed, hidden):
        laboratory.say("what raised no alarm")
        first = found.steps[0] if found.steps else None
        asked = dataclasses.replace(look(laboratory, found, policy), known=first)
        again, more = improvements(laboratory, found.base, found.findings, policy, asked)
        found = dataclasses.replace(found, tried=more | found.tried)
        if named(again, found.tests, laboratory.facts.samples, policy)[1]:
            return dataclasses.replace(found, steps=again, tried=found.tried | more)
    return found


def confirmed(laboratory: Laboratory, found: Selection, policy: DiagnosisPolicy) -> Selection:
    """Return the selection or, where nothing rejects, one of an effect that experiment after experiment confirms.

    What acts at a few instants, as friction that rises near rest, scatters over the seconds of data however large it is. Estimated
    from the others, it must make several experiments likelier by very strong evidence, and none less likely by as much.
    """
    look = _largest(laboratory, [s for s in found.findings.scores if s.statistic >= policy.alarm], policy)
    if not look.ranked:
        return found
    laboratory.say("what scatters over the seconds")
    look = dataclasses.replace(look, single=True)
    steps, more = improvements(laboratory, found.base, found.findings, policy, look)
    found = dataclasses.replace(found, tried=more | found.tried)
    if not steps:
        return found
    first = steps[:1]  # another beside it is left to the next diagnosis
    gains = _held_out_gains(laboratory, found.base, first[0].model)
    confirming = sum(gain >= policy.bic_gain for gain, known in gains if known >= policy.known)
    if confirming < policy.confirming or not all(gain > -policy.bic_gain for gain, _ in gains):
        return found
    if not named(first, found.tests, laboratory.facts.samples, policy)[1]:
        return found
    return dataclasses.replace(found, steps=first, confirmed=(confirming, len(gains)))


def behind_random_forces(laboratory: Laboratory, found: Selection, policy: DiagnosisPolicy) -> Selection:
    """Return the selection or, where nothing rejects beside large random forces, one of effects that take their place.

    With forces as large as the model's own a filter predicts well whatever the model lacks: parts that hit each other show nowhere
    until it follows them.
    """
    base, facts = found.base, laboratory.facts
    # What strikes does so within a sample or two: over a radian it would not look large.
    if max(base.random) < policy.random_large:
        return found
    asked = _masked(laboratory, by_size(laboratory.quiet_scores(base), math.log(facts.samples)))
    if not asked:
        return found
    laboratory.say("what random forces hide")
    steps, more = improvements(laboratory, base, found.findings, policy, _Look(asked, [], "thorough"))
    found = dataclasses.replace(found, tried=more | found.tried)
    count = named(steps, found.tests, facts.samples, policy)[1]
    if not count or not replaces_random_forces(steps[count - 1].model, base, policy):
        return found
    return dataclasses.replace(found, steps=steps, hid=True)


def what_simulations_say(laboratory: Laboratory, found: Selection, policy: DiagnosisPolicy) -> Selection:
    """Return the selection or, where a candidate is large that neither seconds nor experiments confirm, one by simulation.

    Friction near rest acts at a few instants, and a filter with random forces passes over them; a simulation goes astray there.
    """
    if not any(s.statistic >= policy.alarm for s in nameable(laboratory.facts, found.findings.scores)):
        return found
    return selected_by_simulation(laboratory, found, policy, spoken=True) or found


def _held_out_gains(laboratory: Laboratory, before: FittedModel, after: FittedModel) -> list[tuple[float, float]]:
    """Return twice the gain in log-likelihood of each experiment, its pieces together, and how much the others know of it."""
    held_out = laboratory.held_out(before, after)
    each: dict[str, tuple[float, float]] = {}
    for place, (gained, known) in enumerate(zip(held_out.gain, held_out.known, strict=True)):
        if not math.isnan(gained):
            origin = laboratory.facts.origin(place)
            before_it, least = each.get(origin, (0.0, 1.0))
            each[origin] = before_it + 2 * gained, min(least, known)
    return list(each.values())


def improvements(
    laboratory: Laboratory,
    base: FittedModel,
    findings: Findings,
    policy: DiagnosisPolicy,
    look: _Look | None = None,
) -> tuple[list[Step], Tried]:
    """Select effects that improve the model one after the other; return them and what was tried.

    The candidates of every step are those that reject, and those that overshadow them; of the first, those of a look.
    """
    steps: list[Step] = []
    tried: Tried = {}
    now, seen = base, findings
    first_tests = adequacy_tests(findings, policy.critical)
    for _ in range(policy.effects):
        step = _next_step(laboratory, now, seen, tried, policy, look if not steps else None)
        if step is None:
            break
        if look is not None and not steps and (step.gain <= look.least or look.repeats(step, policy)):
            break
        known = tried.get(step.id)  # the first refit with it, alone if it came before what it presupposes
        if steps and known is not None and known[0].added == now.added[:-1]:
            single = alone(laboratory, steps[-1], step, *known, policy)
            if single is not None:
                steps, step = steps[:-1], single
                now = known[0]
        steps = [*steps, step]
        # Where some are named and the next cannot be, the rest is left to the next diagnosis, with those in the model.
        if 0 < named(steps, first_tests, laboratory.facts.samples, policy)[1] < len(steps):
            tried[step.id] = (now, step.model)
            break
        left = laboratory.findings(step.model)
        if left is None:
            steps = steps[:-1]
            break
        tried[step.id] = (now, step.model)
        now, seen = step.model, left
        count = named(steps, first_tests, laboratory.facts.samples, policy)[1]
        if not rejecting(step.left) or 0 < count < len(steps):
            break
    count = named(steps, first_tests, laboratory.facts.samples, policy)[1]
    if count > 1 and not (look is not None and look.single):
        best = with_replacement(laboratory, base, steps[:count], first_tests, tried, policy)
        best = without_superseded(laboratory, base, best, policy)
        if best[0].id == steps[0].id:
            steps = [*best, *steps[count:]]
        elif look is None or best[0].gain > look.least:
            steps = best  # what came after was found beside the others
            tried |= {
                step.id: (before, step.model)
                for before, step in zip([base, *(s.model for s in best)], best, strict=False)
            }
    return steps, tried


def _next_step(
    laboratory: Laboratory,
    now: FittedModel,
    seen: Findings,
    tried: Tried,
    policy: DiagnosisPolicy,
    look: _Look | None,
) -> Step | None:
    """Refit a model with its suspects and return the best; add all of them to those that were tried."""
    price = math.log(laboratory.facts.samples)
    if look is not None:
        way, ranked, above = look.way, look.ranked, []
        near = [*look.near, *presupposed(laboratory, now, seen, ranked)]
        most = len(ranked)
    else:
        way, ranked = "filter", by_size(nameable(laboratory.facts, alarming(seen.scores, policy.critical)), price)
        near = _near(ranked, policy.close) if ranked else []
        above = by_size(nameable(laboratory.facts, overshadowing(seen.scores, policy.critical)), price)[: policy.refits]
        ranked = ranked or beside(laboratory, now, seen, policy)
        near = [*near, *presupposed(laboratory, now, seen, ranked[: policy.refits])]
        most = policy.refits
    if not ranked:
        return None
    near = [*near, *resembling(laboratory, now, seen, [*ranked[:1], *near])]
    models = laboratory.first_refits(now, ranked[0], near, way)
    begun = {s.id for s in (ranked[0], *near)}
    ahead = laboratory.findings(models[ranked[0].id]) if ranked[0].id in models else None
    # Where the best leaves nothing to explain, those far behind it need not be asked.
    settled = ahead is not None and not rejecting(adequacy_tests(ahead, policy.critical))
    far = [] if settled else [*(s for s in ranked[1:most] if s.id not in begun), *above]
    models |= laboratory.refits(now, far, way)
    asked = {s.id: s for s in (*ranked, *near, *above)}
    if way == "equations" and models:
        # What only an output shows, as a sensor's zero, has no part in the equations.
        best = max(models, key=lambda i: models[i].log_likelihood)
        alike = [s for s in resembling(laboratory, now, seen, [asked[best]]) if s.id not in asked]
        models |= laboratory.refits(now, alike, "filter") if alike else {}
        asked |= {s.id: s for s in alike}
    several = {i: (asked[i], model) for i, model in models.items()}
    for i, model in models.items():
        tried.setdefault(i, (now, model))
    laboratory.say("what is left")
    step = chosen(laboratory, now, several, policy)
    left = None if step is None else laboratory.findings(step.model)
    if step is None or left is None:
        return None
    # Whatever was not fitted in time may do as well.
    late = tuple(i for i in laboratory.unfitted(now) if i not in (step.id, *step.rivals))
    return dataclasses.replace(
        step, left=adequacy_tests(left, policy.critical), rivals=(*step.rivals, *late), late=late
    )
