"""The record of a selection of effects, and the order in which candidates are asked."""

import dataclasses
import math
from collections.abc import Sequence

from estimators.diagnosis.evidence import Facts, FittedModel
from estimators.diagnosis.policy import DiagnosisPolicy
from estimators.diagnosis.removed_error import Verdict, named, named_for_simulation
from estimators.diagnosis.step import Step
from estimators.misspecification.adequacy import AdequacyTest, Candidate
from estimators.misspecification.findings import Findings, Score

_SAME = 1e-6  # relative difference of statistics, up to which two effects change the motion in the same way

Tried = dict[str, tuple[FittedModel, FittedModel]]
"""Of every candidate that was tried the model before and after."""


@dataclasses.dataclass(frozen=True)
class Selection:
    """The outcome of a selection.

    Attributes:
        base: the base model, with the noise that was chosen.
        findings: of its innovations.
        tests: of its adequacy.
        steps: the effects that improved it, in order.
        tried: every candidate that was refitted.
        simulated: of a selection by simulation what is left of the base model's squared error before and after each step; else
            empty.
        confirmed: of an effect that raised no alarm, how many experiments confirm it, and of how many; else empty.
        hid: whether the steps were looked for behind large random forces, whose place they take.
        static: whether a force of one variable explains what is missing, so that nothing more was looked for.
    """

    base: FittedModel
    findings: Findings
    tests: tuple[AdequacyTest, ...]
    steps: list[Step]
    tried: Tried
    simulated: tuple[float, ...] = ()
    confirmed: tuple[int, ...] = ()
    hid: bool = False
    static: bool = False

    def named(self, samples: int, policy: DiagnosisPolicy) -> tuple[Verdict, int, float]:
        """Return the verdict, the number of steps that it names, and the fraction of the error that they remove."""
        if self.simulated:
            return named_for_simulation(self.steps, self.simulated, policy)
        return named(self.steps, self.tests, samples, policy)

    def named_model(self, samples: int, policy: DiagnosisPolicy) -> FittedModel:
        """Return the model with the effects that are named; the base model if there is none."""
        count = self.named(samples, policy)[1]
        return self.steps[count - 1].model if count else self.base


def by_size(screened: Sequence[Candidate], price: float) -> list[Candidate]:
    """Return the best shape of every effect, by what it explains less the price of its amplitudes."""
    best: dict[str, Candidate] = {}
    for s in screened:
        if s.id not in best or s.statistic > best[s.id].statistic:
            best[s.id] = s
    return sorted(best.values(), key=lambda s: -(s.statistic - len(s.amplitudes) * price))


def nameable(facts: Facts, several: Sequence[Score]) -> list[Score]:
    """Return the candidates that the data could show at a plausible size: of others, only what a simulation selects is named.

    And what one of these contains, with what changes the motion exactly as that does: else the larger one would be named where
    it is no more than these, as a cable without stiffness is dry friction of an arm that turns one way.
    """
    shown = [s for s in several if s.id not in facts.untestable]
    within = {i for s in shown for i in facts.effects[s.id].contains}
    sizes = [s.statistic for s in several if s.id in within]
    same = [s for s in several if any(math.isclose(s.statistic, size, rel_tol=_SAME) for size in sizes)]
    return [s for s in several if s in shown or s in same]
