"""The candidates that a step asks beside those that are suspected: what they presuppose, resemble, or stand beside."""

import math
from collections.abc import Sequence

from estimators.diagnosis.evidence import FittedModel
from estimators.diagnosis.laboratory import Laboratory
from estimators.diagnosis.policy import DiagnosisPolicy
from estimators.diagnosis.selection import by_size, nameable
from estimators.misspecification.findings import Findings, Score


def beside(laboratory: Laboratory, now: FittedModel, seen: Findings, policy: DiagnosisPolicy) -> list[Score]:
    """Return candidates that presuppose an effect in the model and are large, though they scatter over stretches of time."""
    effects = laboratory.facts.effects
    large = [s for s in seen.scores if s.statistic >= policy.alarm and set(effects[s.id].presupposes) & set(now.added)]
    return by_size(nameable(laboratory.facts, large), math.log(laboratory.facts.samples))


def presupposed(laboratory: Laboratory, now: FittedModel, seen: Findings, ranked: Sequence[Score]) -> list[Score]:
    """Return what candidates presuppose and neither the model nor they themselves have."""
    effects, there = laboratory.facts.effects, {*now.added, *(s.id for s in ranked)}
    asked = {i for s in ranked for i in effects[s.id].presupposes} - there
    return by_size(
        nameable(laboratory.facts, [s for s in seen.scores if s.id in asked]), math.log(laboratory.facts.samples)
    )


def resembling(laboratory: Laboratory, now: FittedModel, seen: Findings, ranked: Sequence[Score]) -> list[Score]:
    """Return what changes the motion as the first candidate does, though its score at small sizes may hide that.

    Whether the data could show it by itself does not matter: they show it where they show the first.
    """
    effects, there = laboratory.facts.effects, {*now.added, *(s.id for s in ranked)}
    alike = {i for s in ranked[:1] for i in effects[s.id].resembles} - there
    return by_size([s for s in seen.scores if s.id in alike], math.log(laboratory.facts.samples))
