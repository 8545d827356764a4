"""The verdict of a diagnosis from its evidence: pure, without a model, and the same whenever it is asked again."""

import dataclasses
import math
from collections.abc import Sequence

from estimators.diagnosis.choice import bic_gain
from estimators.diagnosis.evidence import Evidence, Facts, FittedModel
from estimators.diagnosis.laboratory import Archive, Laboratory
from estimators.diagnosis.policy import STANDARD, DiagnosisPolicy
from estimators.diagnosis.removed_error import Verdict, without_named_rivals
from estimators.diagnosis.selection import Selection
from estimators.diagnosis.step import Step
from estimators.diagnosis.stepwise_selection import gross, select
from estimators.inference.simulation_residual import (
    SimulationResidual,
    is_current_noise,
    random_forces_are_large,
    simulation_residual,
)
from estimators.misspecification.adequacy import AdequacyTest, unconfirmed
from estimators.misspecification.findings import Score

_COMPUTED = {
    "noise": ("colour_little",),
    "candidates": ("testable",),
}
"""Thresholds that the evidence was computed by, and what of it."""


@dataclasses.dataclass(frozen=True)
class Consequence:
    """The part of the base model's rms error that named effects take off, as fractions of it.

    Attributes:
        predicted: of that one sample ahead.
        simulated: of that of a free simulation, of the channel where it is most; None where that was not asked, as the first is
            consequence enough, or no noise is known.
        slight: whether both are too little to matter, so that the model is adequate without them.
    """

    predicted: float
    simulated: float | None
    slight: bool


@dataclasses.dataclass(frozen=True)
class Judgement:
    """The judgement of evidence by one policy.

    Attributes:
        verdict: "adequate", "missing", "ambiguous" or "unknown".
        steps: the effects that are named, with the rivals that the data cannot tell from them, first found first.
        further: effects that improve the model beyond these, and explain too little to be named.
        removed: fraction of the misfit that the steps remove.
        left: the tests with the named effects.
        simulation: what the error of the fitted simulation means; None where it was not asked.
        selection: all steps, and every candidate that was tried.
        consequence: what the named or the detectable effects take off the error; None where there are none.
        detectable: effects that would be named, but are of no consequence.
        incomplete: what the policy would have asked for and the evidence does not hold; empty where the judgement is whole.
    """

    verdict: Verdict
    steps: tuple[Step, ...]
    further: tuple[Step, ...]
    removed: float
    left: tuple[AdequacyTest, ...]
    simulation: SimulationResidual | None
    selection: Selection
    consequence: Consequence | None = None
    detectable: tuple[Step, ...] = ()
    incomplete: tuple[str, ...] = ()

    @property
    def effects(self) -> tuple[str, ...]:
        """Return the ids of the effects that are named."""
        return tuple(step.id for step in self.steps)

    @property
    def rivals(self) -> dict[str, tuple[str, ...]]:
        """Return the ids that the data cannot tell from each named effect."""
        return {step.id: step.rivals for step in self.steps}

    @property
    def final(self) -> FittedModel:
        """Return the model with the named effects; the base model if there is none."""
        return self.steps[-1].model if self.steps else self.selection.base


def judge(evidence: Evidence, policy: DiagnosisPolicy = STANDARD) -> Judgement:
    """Judge evidence by a policy: the verdict, the effects that it names, their rivals, and the fraction that they remove.

    By the policy of the diagnosis this is its verdict. By another the selection is run again over the refits that exist.

    Args:
        evidence: of a diagnosis, as it holds it or as loaded from a file.
        policy: the thresholds.
    """
    archive = Archive(evidence)
    found = decide(archive, policy, thorough=evidence.thorough, laws_first=evidence.laws_first)
    # Evidence of an earlier version was computed by the standard values of what has become a threshold since.
    changed = [
        f"{what} with another {name}"
        for what, names in _COMPUTED.items()
        for name in names
        if evidence.policy.get(name, getattr(STANDARD, name)) != getattr(policy, name)
    ]
    return dataclasses.replace(found, incomplete=(*archive.missing, *changed))


def decide(laboratory: Laboratory, policy: DiagnosisPolicy, *, thorough: bool, laws_first: bool = False) -> Judgement:
    """Select effects, name those that remove nearly everything, and hold that against the error of a simulation.

    Args:
        laboratory: that computes, or knows, what is asked.
        policy: the thresholds.
        thorough: look again at what raised no alarm, where the misfit would stay unknown.
        laws_first: look for nothing more where a force of one variable explains it.
    """
    found = select(laboratory, policy, thorough=thorough, laws_first=laws_first)
    verdict, count, removed = found.named(laboratory.facts.samples, policy)
    simulation = None
    if verdict == "adequate" and (laboratory.facts.silent or laboratory.facts.stuck):
        return Judgement("unknown", (), tuple(found.steps), removed, found.tests, None, found)
    if verdict == "adequate":
        simulation = _of_base(laboratory, found, policy)
    elif count:
        doubted = _unfollowing if gross(laboratory, policy) else _stand_in
        simulation = doubted(laboratory, found.steps[count - 1].model, policy)
    if simulation is not None and simulation.vetoes:
        verdict, count = "unknown", 0
    steps = without_named_rivals(found.steps[:count])
    left = steps[-1].left if steps else found.tests
    further = tuple(found.steps[count:])
    consequence = _consequence(laboratory, found.base, steps, policy) if steps else None
    if consequence is not None and consequence.slight:
        simulation = _of_base(laboratory, found, policy)
        if simulation is None or not simulation.vetoes:  # or else what they mend may be a part of it
            return Judgement("adequate", (), further, removed, left, simulation, found, consequence, tuple(steps))
        simulation = None
    return Judgement(verdict, tuple(steps), further, removed, left, simulation, found, consequence)


def _consequence(
    laboratory: Laboratory, base: FittedModel, steps: Sequence[Step], policy: DiagnosisPolicy
) -> Consequence:
    """Return what effects take off the error; a simulation is asked only where they take little off predictions."""
    predicted = 1.0 - math.exp(-0.5 * sum(step.gain for step in steps) / laboratory.facts.samples)
    if predicted >= policy.consequence or not laboratory.facts.noise_known:
        return Consequence(predicted, None, slight=False)
    before, after = laboratory.simulation(base), laboratory.simulation(steps[-1].model)
    if before is None or after is None:
        return Consequence(predicted, None, slight=False)
    both = before.error.keys() & after.error.keys()
    simulated = max((1.0 - after.error[channel] / before.error[channel] for channel in both), default=0.0)
    return Consequence(predicted, simulated, slight=simulated < policy.consequence)


def _of_base(laboratory: Laboratory, found: Selection, policy: DiagnosisPolicy) -> SimulationResidual | None:
    """Return what the simulation error of the diagnosed fit means beside the random forces of its predictor."""
    critical = policy.critical
    few = unconfirmed(found.findings.scores, laboratory.facts.seconds, critical)
    few = few or [s for s in found.findings.scores if _is_supported(laboratory, found, s, policy)]
    if is_of_the_current(laboratory.facts, found.base.random, policy):
        few = []  # what is known to act needs no effect that would explain it too
    loudest = max(few, key=lambda s: s.statistic, default=None)
    suspect = "" if loudest is None else f"{loudest.id} ({loudest.statistic:.0f}, the alarm is at {critical.alarm:.0f})"
    return _residual(laboratory, found.base, policy, suspect)


def _is_supported(laboratory: Laboratory, found: Selection, one: Score, policy: DiagnosisPolicy) -> bool:
    """Return whether a candidate is large, and a refit with it predicts what it was not estimated from, though nothing confirms it.

    As friction that acts in two of three experiments, and hardly in the third.
    """
    before, after = found.tried.get(one.id, (None, None))
    if one.statistic < policy.alarm or before is None or after is None or before.number != found.base.number:
        return False
    gains = [2 * gain for gain in laboratory.held_out(before, after).gain if not math.isnan(gain)]
    return min(bic_gain(laboratory.facts.samples, before, after), sum(gains)) >= policy.bic_gain


def _stand_in(laboratory: Laboratory, final: FittedModel, policy: DiagnosisPolicy) -> SimulationResidual | None:
    """Return what the simulation of a model with effects added misses, where random forces stand in for the physics.

    An effect of the catalogue may take the best part of what another mistake leaves, and random forces the rest, so that
    nothing rejects any more. A simulation is asked only where the random forces are large.

    Returns:
        None where the random forces are modest, or the simulation follows.
    """
    if not random_forces_are_large(final.random, laboratory.facts.samples_per_radian, policy.simulation):
        return None
    found = _residual(laboratory, final, policy, "")
    return found if found is not None and found.cause == "stand-in" else None


def _unfollowing(laboratory: Laboratory, final: FittedModel, policy: DiagnosisPolicy) -> SimulationResidual | None:
    """Return what the simulation of a model with effects added misses, where the base model's followed nothing.

    Against a model that follows nothing everything improves the predictions. A filter without random forces is a simulation, which
    meets the data or not; one with some is asked for the simulation itself.

    Returns:
        None where there are next to no random forces, or the simulation follows as far as they let it.
    """
    if max(final.random) < policy.consequence:
        return None
    found = _residual(laboratory, final, policy, "")
    # What is missing beside what is named, and random forces stand for, is for the next diagnosis.
    return found if found is not None and found.vetoes and not found.overstated else None


def _residual(
    laboratory: Laboratory, model: FittedModel, policy: DiagnosisPolicy, suspect: str
) -> SimulationResidual | None:
    error, facts = laboratory.simulation(model), laboratory.facts
    if error is None:
        return None
    found = simulation_residual(
        error.error, error.shaken, error.signal, random=error.random, suspect=suspect, seconds=facts.seconds,
        samples_per_radian=facts.samples_per_radian, experiments=facts.experiments, noise_known=facts.noise_known,
        unknown=error.unknown, added=model.added, limits=policy.simulation,
        of_the_current=is_of_the_current(facts, error.random, policy),
    )  # fmt: skip
    # A fit that ended elsewhere than at the best, or a motion that no simulation can follow, is no failing of the model: where no
    # noise is known, random forces in place of its own are.
    # A simulation of what is fitted that follows nothing is none of these: predictions may have called the motion noise.
    lost = not model.added and found.vetoes and found.signal_fraction > policy.simulation.unfollowed
    # As is what may be an effect that so few data could not confirm.
    spoken = found.cause == "stand-in" or found.overstated or lost or bool(suspect)
    return found if facts.noise_known or spoken else None


def is_of_the_current(facts: Facts, random: tuple[float, float], policy: DiagnosisPolicy) -> bool:
    """Return whether random forces are the noise of a measured current."""
    return is_current_noise(random, facts.current_noise, force=policy.consequence, times=policy.simulation.beyond)
