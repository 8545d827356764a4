"""The models of a live laboratory: what was fitted and tested, with what made it, and the record of it."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from estimators.core.deadline import Deadline
from estimators.diagnosis.evidence import FittedModel, Refitting
from estimators.diagnosis.gross_effects import screened_by_equations
from estimators.diagnosis.innovation_tests import limits_of, run_tests, scores_of, screened_at_low_noise
from estimators.diagnosis.laboratory import Way
from estimators.diagnosis.refit import Refit, Tested
from estimators.diagnosis.refitting import looseness_of, parameters_of
from estimators.diagnosis.setting import Setting
from estimators.misspecification.candidate_screening import Screened, by_statistic, correlations
from estimators.misspecification.equation_screening import Explained
from estimators.misspecification.findings import Score
from estimators.validation.vuong_test import by_stretch


class Detectability(NamedTuple):
    """The limits of what the data could show of candidates beside a model.

    Attributes:
        limits: size from which on each would be found.
        correlations: of what each two would change.
    """

    limits: dict[str, float]
    correlations: dict[str, dict[str, float]]


class ComputedModels:
    """The models of a diagnosis by number: predictors, tests and scores, each computed once.

    Attributes:
        records: of all, the base model first.
        tests: of those that were tested, by number.
        quiet: scores against predictors with low process noise, by number.
        equations: scores by equation errors, by number.
        refits: which model came of which by which candidate; None where it diverged.
        unfitted: candidates whose refits beside a model were broken off, as the time was over, by its number.
    """

    def __init__(self, stretches: np.ndarray) -> None:
        """Begin without any; `stretches` says of each sample by which the likelihood is kept."""
        self.records: list[FittedModel] = []
        self.tests: dict[int, Tested] = {}
        self.quiet: dict[int, tuple[Score, ...]] = {}
        self.equations: dict[int, tuple[Score, ...]] = {}
        self.refits: dict[tuple[int, str, str], Refitting] = {}
        self.unfitted: dict[int, set[str]] = {}
        self._computed: list[tuple[Setting, Refit]] = []
        self._detectable: dict[int, Detectability] = {}
        self._explained: dict[Score, Explained] = {}
        self._screened: dict[Score, Screened] = {}
        self._stretches = stretches

    def begin(
        self, setting: Setting, base: Refit, tested: Tested
    ) -> tuple[FittedModel, dict[str, float], dict[str, Screened]]:
        """Record the base model with its tests; return the limits and the best shape of each candidate beside it."""
        best = by_statistic(tested.screened)
        found = _detectability(setting, base, best)
        model = self.record(setting, base, tested)
        self._detectable[model.number] = found
        return model, found.limits, best

    def computed(self, model: FittedModel) -> tuple[Setting, Refit]:
        """Return what a record stands for, and what made it."""
        return self._computed[model.number]

    def tested(self, model: FittedModel) -> Tested:
        """Return the tests of the innovations of a model, with what they were computed from."""
        if model.number not in self.tests:
            setting, refit = self.computed(model)
            tested = run_tests(setting, refit)
            if not model.added:  # a base model with coloured noise
                self._detectable[model.number] = _detectability(setting, refit, by_statistic(tested.screened))
            self.tests[model.number] = tested = tested.without_templates()
            self._screened |= dict(zip(tested.findings.scores, tested.screened, strict=True))
        return self.tests[model.number]

    def detectability(self, model: FittedModel) -> Detectability:
        """Return what the data could show beside a base model."""
        self.tested(model)
        return self._detectable[model.number]

    def quiet_scores(self, model: FittedModel) -> tuple[Score, ...]:
        """Score candidates against a predictor with low process noise."""
        if model.number not in self.quiet:
            setting, refit = self.computed(model)
            screened = [s.without_templates() for s in screened_at_low_noise(setting, refit)]
            scores = self.quiet[model.number] = scores_of(screened)
            self._screened |= dict(zip(scores, screened, strict=True))
        return self.quiet[model.number]

    def equation_scores(self, model: FittedModel) -> tuple[Score, ...]:
        """Score candidates by what they take off the equation error of a model."""
        if model.number not in self.equations:
            setting, refit = self.computed(model)
            estimated = refit.model.with_values({n: v for n, v in refit.values.items() if n in refit.model.parameters})
            explained = screened_by_equations(setting, estimated, refit.added)
            scores = tuple(
                Score(e.id, place, e.amplitudes, float(e.statistic), e.p_value, tuple(np.asarray(e.begin).tolist()))
                for place, e in enumerate(explained)
            )
            self.equations[model.number] = scores
            self._explained |= dict(zip(scores, explained, strict=True))
        return self.equations[model.number]

    def held(self, several: Sequence[Score]) -> list[Screened | Explained]:
        """Return what scores were computed from: equations of motion, or innovations."""
        return [self._explained[s] if s in self._explained else self._screened[s] for s in several]

    def add(
        self,
        before: FittedModel,
        several: Sequence[Score],
        way: Way,
        found: dict[str, Refit],
        tested: dict[str, Tested | None],
    ) -> dict[str, FittedModel]:
        """Record refits with candidates, and those that diverged."""
        setting, _ = self.computed(before)
        models = {i: self.record(setting, refit, tested.get(i)) for i, refit in found.items()}
        for s in several:
            key, after = (before.number, way, s.id), models[s.id].number if s.id in models else None
            if after is not None or key not in self.refits:  # one that is asked again may be broken off
                self.refits[key] = Refitting(before.number, way, s.id, s.shape, after)
        return models

    def miss(
        self, before: FittedModel, asked: Sequence[Score], found: Mapping[str, object], deadline: Deadline
    ) -> None:
        """Note which of several candidates were not fitted beside a model, where the time was over meanwhile."""
        if deadline.missed:
            self.unfitted.setdefault(before.number, set()).update(s.id for s in asked if s.id not in found)

    def record(self, setting: Setting, refit: Refit, tested: Tested | None) -> FittedModel:
        """Record a refit, with its tests where there are any."""
        values = {
            f"{effect}.{name}": (parameter.value, parameter.std)
            for effect in refit.added
            for name, parameter in parameters_of(effect, refit).items()
        }
        model = FittedModel(
            number=len(self.records),
            added=refit.added,
            parameters=len(refit.free),
            log_likelihood=float(refit.predictor.log_likelihood),
            by_stretch=tuple(by_stretch(refit.by_sample, self._stretches).tolist()),
            looseness=looseness_of(refit),
            random_force=float(refit.predictor.random_force),
            random_torque=float(refit.predictor.random_torque),
            values=values,
        )
        self.records.append(model)
        self._computed.append((setting, refit))
        if tested is not None:
            self.tests[model.number] = tested = tested.without_templates()
            self._screened |= dict(zip(tested.findings.scores, tested.screened, strict=True))
        return model


def _detectability(setting: Setting, refit: Refit, best: Mapping[str, Screened]) -> Detectability:
    return Detectability(limits_of(setting, refit, best), correlations(best))
