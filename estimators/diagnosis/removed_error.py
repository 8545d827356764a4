"""The fraction of the squared prediction error that effects remove, and which of them a verdict names for it."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Literal

from estimators.diagnosis.policy import DiagnosisPolicy
from estimators.diagnosis.step import Step
from estimators.misspecification.adequacy import AdequacyTest, excess_of

Verdict = Literal["adequate", "missing", "ambiguous", "unknown"]


def named(
    steps: Sequence[Step], tests: Sequence[AdequacyTest], samples: int, policy: DiagnosisPolicy
) -> tuple[Verdict, int, float]:
    """Return the verdict, the number of steps that it names, and the fraction of the misfit that they remove.

    The best of a bad set is never named: an effect is, if together with those named after it, it removes nearly
    everything that was wrong before it. So a strong effect does not carry a doubtful one along.
    """
    for count in range(len(steps), 0, -1):
        fractions = [fraction_removed(steps[first:count], samples) for first in range(count)]
        if min(fractions) >= policy.removed:
            open_question = any(step.rivals for step in without_named_rivals(steps[:count]))
            return ("ambiguous" if open_question else "missing"), count, fractions[0]
    if not steps:
        return ("unknown" if any(test.rejects for test in tests) else "adequate"), 0, 0.0
    return "unknown", 0, fraction_removed(steps, samples)


def named_for_simulation(
    steps: Sequence[Step], left: Sequence[float], policy: DiagnosisPolicy
) -> tuple[Verdict, int, float]:
    """Return the same of steps that were selected by simulation.

    Args:
        steps: in their order.
        left: of the base model's squared error, before and after each.
        policy: the thresholds.
    """
    for count in range(len(steps), 0, -1):
        if all(left[count] <= policy.left * before for before in left[:count]):
            open_question = any(step.rivals for step in without_named_rivals(steps[:count]))
            return ("ambiguous" if open_question else "missing"), count, 1 - left[count]
    return "unknown", 0, 1 - left[-1]


def without_named_rivals(steps: Sequence[Step]) -> list[Step]:
    """Return the steps without those rivals that were named as well.

    They act beside each other, not instead of each other.
    """
    named = {step.id for step in steps}
    return [dataclasses.replace(step, rivals=tuple(r for r in step.rivals if r not in named)) for step in steps]


def fraction_removed(steps: Sequence[Step], samples: int) -> float:
    """Return the fraction of the excess squared prediction error that steps remove."""
    after = math.exp(-sum(step.gain for step in steps) / samples)
    return (1 - after) / (1 - floor(steps, samples))


def removed_beside(steps: Sequence[Step], samples: int, left: float) -> float:
    """Return the fraction of the excess that steps remove, if so much is left in place of what the tests still find.

    Args:
        steps: of the selection.
        samples: that it was made of.
        left: mean square of the innovations of the model with them, where 1 is their own variance.
    """
    after = math.exp(-sum(step.gain for step in steps) / samples)
    return (1 - after) / (1 - after / max(left, 1.0)) if after < 1 else 0.0


def floor(steps: Sequence[Step], samples: int) -> float:
    """Return the squared prediction error that would be left if what the tests still find were explained too.

    It is a fraction of the first model's.
    """
    after = math.exp(-sum(step.gain for step in steps) / samples)
    return after * (1 - min(excess_of(steps[-1].left) / samples, 1.0))
