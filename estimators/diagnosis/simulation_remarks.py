"""Remarks of a diagnosis where simulations, and not predictions one sample ahead, decide what is named."""

from collections.abc import Collection, Mapping, Sequence

from estimators.diagnosis.candidate import Candidate
from estimators.diagnosis.evidence import SimulationError
from estimators.diagnosis.policy import DiagnosisPolicy
from estimators.diagnosis.removed_error import without_named_rivals
from estimators.diagnosis.step import Step
from estimators.inference.simulation_residual import SimulationResidual, random_forces
from estimators.misspecification.adequacy import AdequacyTest
from rtac_jax.measurement import OUTPUTS

_SHOWN = 3  # of what was not fitted, by name


def found_by_simulation(before: SimulationError, after: SimulationError, coloured: Mapping[str, float]) -> str:
    """Say why effects were selected by simulation, and how far its error falls with them.

    Args:
        before: the simulation of the fit that is diagnosed, beside its predictor.
        after: that with the effects.
        coloured: noise that was assumed, of which errors are multiples, by channel [its unit].
    """
    farthest = max(before.error, key=lambda channel: before.error[channel])
    noise = (
        f"the coloured noise, of {coloured[farthest]:.2g} {OUTPUTS[farthest]} rms"
        if farthest in coloured
        else "the noise"
    )
    return (
        " This is what simulations select, as predictions one sample ahead do not tell: random forces stand in for the physics"
        f" there ({random_forces(before.random)}). The"
        f" error of the simulation falls from {before.error[farthest]:,.3g} to {after.error[farthest]:,.3g} times {noise}"
        f" ({farthest})."
    )


def of_nearest(near: Sequence[Candidate]) -> str:
    """Say which effects take most of the error of a simulation off that nothing explains, and how much; nothing of none."""
    if not near:
        return ""

    def said(one: Candidate) -> str:
        size = ", ".join(f"{name} = {p.value:.3g} {p.unit}".removesuffix(" 1") for name, p in one.parameters.items())
        return f"{one.id} ({size}) {100 * one.error_reduction:.0f} %"

    return (
        " A simulation that is fitted, in a few steps, with one effect more loses of its squared error beyond the noise: with "
        f"{', with '.join(map(said, near[:_SHOWN]))}."
    )


def without_the_physics(steps: Sequence[Step], simulation: SimulationResidual) -> str:
    """Return what the predictions speak for where a simulation with it does not follow, so that it is not named."""
    names = " and ".join(" or ".join([step.id, *step.rivals]) for step in without_named_rivals(steps))
    if simulation.cause != "stand-in":
        return f" That is with {names}, which would improve the predictions; without the simulation that follows it is not named."
    return (
        f" {names} would improve the predictions, but random forces stand in for the physics beside it too: it may make up for"
        " a part of another mistake, so it is not named."
    )


def untried(
    candidates: Sequence[Candidate], fitted: Collection[str], left: Sequence[AdequacyTest], policy: DiagnosisPolicy
) -> str:
    """Name what is as large as an alarm and was not fitted, where what is named leaves something; nothing elsewhere.

    Simulations do not try what acts by contact, whose hits no descent follows.

    Args:
        candidates: of the diagnosis.
        fitted: ids of those that were fitted by simulation.
        left: tests of the model with what is named.
        policy: the thresholds.
    """
    if not any(test.rejects for test in left):
        return ""
    never = [c for c in candidates if not c.refitted and c.id not in fitted]
    large = sorted((c for c in never if c.chi_square >= policy.alarm), key=lambda c: -c.chi_square)
    if not large:
        return ""
    shown = ", ".join(f"{c.id} ({c.chi_square:.0f}, the alarm is at {policy.alarm:.0f})" for c in large[:_SHOWN])
    return (
        f" Not fitted so far, and not ruled out beside what is named: {shown}; a diagnosis of the mended model asks for these, and"
        " where there is none --add NAME (rtac improve) tries one of them."
    )
