"""The laboratory that computes: refits and tests on the data, each once, with a record of all of them as evidence."""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from estimators.core.data import moving, origins
from estimators.core.deadline import PROLONGED, Deadline, OutOfTimeError
from estimators.core.fit import Fit, Parameter
from estimators.diagnosis.evidence import (
    EffectTraits,
    Evidence,
    Facts,
    FittedModel,
    HeldOut,
    Refitting,
    SimulationError,
)
from estimators.diagnosis.gross_effects import screened_by_equations
from estimators.diagnosis.innovation_tests import (
    limits_of,
    run_tests,
    scores_of,
    screened_at_low_noise,
    simulation_error,
)
from estimators.diagnosis.laboratory import Way
from estimators.diagnosis.noise_colour import coloured, recoloured
from estimators.diagnosis.refit import Refit, Tested
from estimators.diagnosis.refitting import (
    extended_simulation,
    fit_base,
    held_out_gains,
    looseness_of,
    parameters_of,
    refit_each,
    refit_first,
)
from estimators.diagnosis.setting import Setting
from estimators.diagnosis.simulated_fits import SimulatedFits
from estimators.diagnosis.simulation_selection import excess_left
from estimators.diagnosis.workers import Workers
from estimators.inference.shaken_simulation import unfollowed
from estimators.inference.simulation_residual import judged_channels
from estimators.misspecification.candidate_screening import Screened, by_statistic, correlations
from estimators.misspecification.detection_limit import may_show
from estimators.misspecification.equation_screening import Explained
from estimators.misspecification.findings import Findings, Score
from estimators.validation.vuong_test import by_stretch
from rtac_jax.effects import Effect


class Detectability(NamedTuple):
    """The limits of what the data could show of candidates beside a model.

    Attributes:
        limits: size from which on each would be found.
        correlations: of what each two would change.
    """

    limits: dict[str, float]
    correlations: dict[str, dict[str, float]]


class LiveLaboratory:
    """A laboratory that computes the answers to a selection's questions, each question once.

    Attributes:
        facts: about the recording.
        policy: the thresholds by which is chosen what to compute.
        base: the record of the base model.
    """

    def __init__(
        self, setting: Setting, fit: Fit, base: Refit, tested: Tested, workers: Workers, deadline: Deadline
    ) -> None:
        """Begin with the base model and its tests.

        Args:
            setting: the data and the candidates.
            fit: that is diagnosed.
            base: predictor of its model.
            tested: the tests of that.
            workers: compute side by side.
            deadline: after which no refit goes on.
        """
        self._fit, self._workers, self._progress, self._deadline = fit, workers, setting.progress, deadline
        self._models: list[FittedModel] = []
        self._computed: list[tuple[Setting, Refit]] = []
        self._tested: dict[int, Tested] = {}
        self._quiet: dict[int, tuple[Score, ...]] = {}
        self._equations: dict[int, tuple[Score, ...]] = {}
        self._explained: dict[Score, Explained] = {}
        self._screened: dict[Score, Screened] = {}
        self._refits: dict[tuple[int, str, str], Refitting] = {}
        self._held_out: dict[tuple[int, int], HeldOut] = {}
        self._simulations: dict[int, SimulationError] = {}
        self._simulated = SimulatedFits(fit, workers)
        self._coloured: list[FittedModel | None] = []  # empty until asked
        self._broken_off: set[str] = set()
        self._unfitted: dict[int, set[str]] = {}
        self._stretches = setting.stretches()
        self.facts, self.policy = facts_of(setting, fit), setting.policy
        best = by_statistic(tested.screened)
        found = _detectability(setting, base, best)
        self.base = self._record(setting, base, tested)
        self._detectable = {self.base.number: found}
        shown = {i for i, s in best.items() if may_show(s, found.limits[i], setting.policy.testable)}
        blind = [i for i, s in best.items() if not s.instance.acts_by_contact and i not in shown]
        self.facts = dataclasses.replace(self.facts, untestable=tuple(sorted(blind)))

    @property
    def broken_off(self) -> tuple[str, ...]:
        """Return what was asked and not computed, as the time was over: candidates by id, and what else."""
        return tuple(sorted(self._broken_off.union(*self._unfitted.values())))

    def say(self, text: str) -> None:
        """Show what is asked now."""
        self._progress.at(f"diagnose: {text}")

    def first_refits(
        self, before: FittedModel, first: Score, near: Sequence[Score], way: Way
    ) -> dict[str, FittedModel]:
        """Refit a model with the first candidate and those near it, and test the first meanwhile."""
        setting, refit = self.computed(before)
        held = self._held([first, *near])
        with self._deadline.kept():
            found, tested = refit_first(setting, refit, held[0], held[1:], way, self._workers)
        self._note_time(before, [first, *near], found)
        return self._added(before, [first, *near], way, found, {first.id: tested})

    def refits(self, before: FittedModel, several: Sequence[Score], way: Way) -> dict[str, FittedModel]:
        """Refit a model with each of several candidates."""
        if way == "simulation":
            with self._deadline.kept():
                return self._refits_from_simulation(before, several)
        setting, refit = self.computed(before)
        with self._deadline.kept():
            found = refit_each(setting, refit, self._held(several), way, self._workers)
        self._note_time(before, several, found)
        return self._added(before, several, way, found, {})

    def unfitted(self, before: FittedModel) -> tuple[str, ...]:
        """Return the candidates whose refits beside a model were broken off, as the time was over."""
        return tuple(sorted(self._unfitted.get(before.number, ())))

    def findings(self, model: FittedModel) -> Findings:
        """Test the innovations of a model."""
        return self.tested(model).findings

    def quiet_scores(self, model: FittedModel) -> tuple[Score, ...]:
        """Score candidates against a predictor with low process noise."""
        if model.number not in self._quiet:
            setting, refit = self.computed(model)
            screened = [s.without_templates() for s in screened_at_low_noise(setting, refit)]
            scores = self._quiet[model.number] = scores_of(screened)
            self._screened |= dict(zip(scores, screened, strict=True))
        return self._quiet[model.number]

    def equation_scores(self, model: FittedModel) -> tuple[Score, ...]:
        """Score candidates by what they take off the equation error of a model."""
        if model.number not in self._equations:
            setting, refit = self.computed(model)
            estimated = refit.model.with_values({n: v for n, v in refit.values.items() if n in refit.model.parameters})
            explained = screened_by_equations(setting, estimated, refit.added)
            scores = tuple(
                Score(e.id, place, e.amplitudes, float(e.statistic), e.p_value, tuple(np.asarray(e.begin).tolist()))
                for place, e in enumerate(explained)
            )
            self._equations[model.number] = scores
            self._explained |= dict(zip(scores, explained, strict=True))
        return self._equations[model.number]

    def held_out(self, before: FittedModel, after: FittedModel) -> HeldOut:
        """Return what an effect gains where it was not estimated."""
        key = before.number, after.number
        if key not in self._held_out:
            _, refit = self.computed(before)
            self._held_out[key] = held_out_gains(refit, self.computed(after)[1])
        return self._held_out[key]

    def coloured(self, beside: FittedModel) -> FittedModel | None:
        """Return the base model with coloured noise, if the data are likelier with it, and may be than with another model."""
        if not self._coloured and self._deadline.over:
            self._broken_off.add("the colour of the noise")
            return None
        if not self._coloured:
            setting, base = self.computed(self.base)
            other = coloured(setting, base, self._workers, beside.log_likelihood)
            if other is None:
                self._coloured = [None]
            else:
                other, base = recoloured(other, fit_base(other))
                self._coloured = [self._record(other, base, None)]
        return self._coloured[0]

    def simulation(self, model: FittedModel) -> SimulationError:
        """Return the error of a free simulation of a model: of a base model that of the fit that is diagnosed."""
        if model.number not in self._simulations:
            setting, refit = self.computed(model)
            make = extended_simulation if model.added else simulation_error
            try:
                # What is named may be a stand-in, so it is given time beyond the end.
                with self._deadline.prolonged(PROLONGED).kept():
                    found = make(setting, self._fit, refit)
            except OutOfTimeError:
                self._broken_off.add(f"a simulation with {', '.join(model.added)}")
                found = simulation_error(
                    setting, self._fit, refit
                )  # without the effects, as where none can be fitted with them
            self._simulations[model.number] = found
        return self._simulations[model.number]

    def simulation_errors(self, before: FittedModel, several: Sequence[Score]) -> dict[str, Mapping[str, float]]:
        """Return the rms error over the noise, by channel, that a simulation fitted with each of several candidates leaves."""
        with self._deadline.kept():
            self._simulated.extend(before.number, *self.computed(before), self._held(several))
        found = {s.id: self._simulated.errors[before.number, s.id] for s in several}
        found = {effect: errors for effect, errors in found.items() if errors}
        self._note_time(before, several, found)
        return found

    def nearest_simulated(self, before: FittedModel) -> list[tuple[str, float, dict[str, Parameter]]]:
        """Return the candidates that take most of the squared error of a model's simulation beyond the noise off.

        With what each takes off, and its parameters, in the order of that.
        """
        base, fits = self.simulation(before).error, self._simulated.with_one(before.number)
        left = {i: excess_left(fit.residual_over_noise, base, self.policy) for i, fit in fits.items()}
        near = sorted((i for i in left if left[i] <= 1 - self.policy.static), key=lambda i: left[i])
        return [
            (i, 1 - left[i], {n.split(".")[1]: p for n, p in fits[i].parameters.items() if n.split(".")[0] == i})
            for i in near
        ]

    def computed(self, model: FittedModel) -> tuple[Setting, Refit]:
        """Return what a record stands for, and what made it."""
        return self._computed[model.number]

    def tested(self, model: FittedModel) -> Tested:
        """Return the tests of the innovations of a model, with what they were computed from."""
        if model.number not in self._tested:
            setting, refit = self.computed(model)
            tested = run_tests(setting, refit)
            if not model.added:  # a base model with coloured noise
                self._detectable[model.number] = _detectability(setting, refit, by_statistic(tested.screened))
            self._tested[model.number] = tested = tested.without_templates()
            self._screened |= dict(zip(tested.findings.scores, tested.screened, strict=True))
        return self._tested[model.number]

    def detectability(self, model: FittedModel) -> Detectability:
        """Return what the data could show beside a base model."""
        self.tested(model)
        return self._detectable[model.number]

    def evidence(self, *, thorough: bool, laws_first: bool) -> Evidence:
        """Return everything that was computed so far.

        Args:
            thorough: whether what raised no alarm was looked at again.
            laws_first: whether that was left off where a force of one variable explains what is missing.
        """
        with contextlib.suppress(ArithmeticError):  # cheap, and any policy may ask for it
            self.simulation(self.base)
        coloured = self._coloured[0] if self._coloured else None
        return Evidence(
            facts=self.facts,
            thorough=thorough,
            laws_first=laws_first,
            models=tuple(self._models),
            coloured=None if coloured is None else coloured.number,
            colour_asked=bool(self._coloured),
            refits=tuple(self._refits.values()),
            findings={number: tested.findings for number, tested in self._tested.items()},
            quiet=dict(self._quiet),
            held_out=dict(self._held_out),
            simulations=dict(self._simulations),
            policy=self.policy.as_dict(),
            equations=dict(self._equations),
            simulated=dict(self._simulated.errors),
            broken_off=self.broken_off,
            unfitted={number: tuple(sorted(several)) for number, several in self._unfitted.items() if several},
        )

    def _held(self, several: Sequence[Score]) -> list[Screened | Explained]:
        """Return what scores were computed from: equations of motion, or innovations."""
        return [self._explained[s] if s in self._explained else self._screened[s] for s in several]

    def _note_time(self, before: FittedModel, asked: Sequence[Score], found: Mapping[str, object]) -> None:
        """Note which of several candidates were not fitted beside a model, where the time was over meanwhile."""
        if self._deadline.missed:
            self._unfitted.setdefault(before.number, set()).update(s.id for s in asked if s.id not in found)

    def _refits_from_simulation(self, before: FittedModel, several: Sequence[Score]) -> dict[str, FittedModel]:
        """Refit a model with each of several candidates from where a simulation with it ended, and keep that as the model's."""
        setting, refit = self.computed(before)
        fits: dict[str, Fit] = {}
        found: dict[str, Refit] = {}
        for s in self._held(several):
            fit = self._simulated.finish(before.number, s.id, setting)
            after = None if fit is None else self._simulated.predictor_from(fit, setting, refit, s)
            if fit is not None and after is not None:
                fits[s.id], found[s.id] = fit, after
        self._note_time(before, several, found)
        models = self._added(before, several, "simulation", found, {})
        for effect, model in models.items():
            self._simulated.keep(model.number, fits[effect])
            self._simulations[model.number] = simulation_error(setting, fits[effect], found[effect])
        return models

    def _added(
        self,
        before: FittedModel,
        several: Sequence[Score],
        way: Way,
        found: dict[str, Refit],
        tested: dict[str, Tested | None],
    ) -> dict[str, FittedModel]:
        """Record refits with candidates, and those that diverged."""
        setting, _ = self.computed(before)
        models = {i: self._record(setting, refit, tested.get(i)) for i, refit in found.items()}
        for s in several:
            key, after = (before.number, way, s.id), models[s.id].number if s.id in models else None
            if after is not None or key not in self._refits:  # one that is asked again may be broken off
                self._refits[key] = Refitting(before.number, way, s.id, s.shape, after)
        return models

    def _record(self, setting: Setting, refit: Refit, tested: Tested | None) -> FittedModel:
        values = {
            f"{effect}.{name}": (parameter.value, parameter.std)
            for effect in refit.added
            for name, parameter in parameters_of(effect, refit).items()
        }
        model = FittedModel(
            number=len(self._models),
            added=refit.added,
            parameters=len(refit.free),
            log_likelihood=float(refit.predictor.log_likelihood),
            by_stretch=tuple(by_stretch(refit.by_sample, self._stretches).tolist()),
            looseness=looseness_of(refit),
            random_force=float(refit.predictor.random_force),
            random_torque=float(refit.predictor.random_torque),
            values=values,
        )
        self._models.append(model)
        self._computed.append((setting, refit))
        if tested is not None:
            self._tested[model.number] = tested = tested.without_templates()
            self._screened |= dict(zip(tested.findings.scores, tested.screened, strict=True))
        return model


def _detectability(setting: Setting, refit: Refit, best: Mapping[str, Screened]) -> Detectability:
    return Detectability(limits_of(setting, refit, best), correlations(best))


def facts_of(setting: Setting, fit: Fit) -> Facts:
    """Return what a judgement asks of the recording.

    Args:
        setting: of the diagnosis.
        fit: that is diagnosed.
    """
    whole = origins(moving(setting.recording))
    return Facts(
        samples=setting.samples,
        seconds=int(np.max(setting.stretches())) + 1,
        experiments=len(setting.experiments),
        rest=any(e.kind == "rest" for e in setting.recording.experiments),
        noise_known=judged_channels(fit.residual_std, setting.recording)[1],
        samples_per_radian=float(setting.samples_per_radian),
        left_out=float(setting.left_out),
        noise={channel: float(level) for channel, level in fit.noise.items()},
        effects={i: traits(effect) for i, effect in setting.classes.items()},
        unfollowed=unfollowed(fit, setting.data, setting.policy.simulation),
        origins=tuple(whole[e.name] for e in setting.experiments),
        current_noise=setting.current_noise,
        travel=setting.travel,
    )


def traits(effect: type[Effect]) -> EffectTraits:
    """Return what a selection asks of a class of effects."""
    return EffectTraits(
        contact=bool(effect.acts_by_contact), contains=tuple(effect.contains), edge=tuple(effect.edge or ()),
        presupposes=tuple(effect.presupposes), resembles=tuple(effect.resembles),
    )  # fmt: skip
