"""The laboratory that computes: refits and tests on the data, each once, with a record of all of them as evidence."""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from estimators.core.data import moving, origins
from estimators.core.deadline import PROLONGED, Deadline, OutOfTimeError
from estimators.core.fit import Fit
from estimators.diagnosis.base_predictor import fit_base
from estimators.diagnosis.computed_models import ComputedModels
from estimators.diagnosis.evidence import (
    EffectTraits,
    Evidence,
    Facts,
    FittedModel,
    HeldOut,
    SimulationError,
)
from estimators.diagnosis.innovation_tests import (
    simulation_error,
)
from estimators.diagnosis.laboratory import Way
from estimators.diagnosis.noise_colour import coloured, recoloured
from estimators.diagnosis.refit import Refit, Tested
from estimators.diagnosis.refitting import extended_simulation, held_out_gains, refit_each, refit_first
from estimators.diagnosis.setting import Setting
from estimators.diagnosis.simulated_fits import SimulatedFits
from estimators.diagnosis.workers import Workers
from estimators.inference.shaken_simulation import unfollowed
from estimators.inference.simulation_residual import judged_channels
from estimators.misspecification.detection_limit import may_show
from estimators.misspecification.findings import Findings, Score
from rtac_jax.effects import Effect


class LiveLaboratory:
    """A laboratory that computes the answers to a selection's questions, each question once.

    Attributes:
        facts: about the recording.
        policy: the thresholds by which is chosen what to compute.
        base: the record of the base model.
        models: all that were computed.
        simulated: fits by simulation of models with candidates.
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
        self.models, self.simulated = ComputedModels(setting.stretches()), SimulatedFits(fit, workers)
        self._held_out: dict[tuple[int, int], HeldOut] = {}
        self._simulations: dict[int, SimulationError] = {}
        self._coloured: list[FittedModel | None] = []  # empty until asked
        self._broken_off: set[str] = set()
        self.facts, self.policy = facts_of(setting, fit), setting.policy
        self.base, limits, best = self.models.begin(setting, base, tested)
        shown = {i for i, s in best.items() if may_show(s, limits[i], setting.policy.testable)}
        blind = [i for i, s in best.items() if not s.instance.acts_by_contact and i not in shown]
        self.facts = dataclasses.replace(self.facts, untestable=tuple(sorted(blind)))

    @property
    def broken_off(self) -> tuple[str, ...]:
        """Return what was asked and not computed, as the time was over: candidates by id, and what else."""
        return tuple(sorted(self._broken_off.union(*self.models.unfitted.values())))

    def say(self, text: str) -> None:
        """Show what is asked now."""
        self._progress.at(f"diagnose: {text}")

    def first_refits(
        self, before: FittedModel, first: Score, near: Sequence[Score], way: Way
    ) -> dict[str, FittedModel]:
        """Refit a model with the first candidate and those near it, and test the first meanwhile."""
        setting, refit = self.models.computed(before)
        held = self.models.held([first, *near])
        with self._deadline.kept():
            found, tested = refit_first(setting, refit, held[0], held[1:], way, self._workers)
        self.models.miss(before, [first, *near], found, self._deadline)
        return self.models.add(before, [first, *near], way, found, {first.id: tested})

    def refits(self, before: FittedModel, several: Sequence[Score], way: Way) -> dict[str, FittedModel]:
        """Refit a model with each of several candidates."""
        if way == "simulation":
            with self._deadline.kept():
                return self._refits_from_simulation(before, several)
        setting, refit = self.models.computed(before)
        with self._deadline.kept():
            found = refit_each(setting, refit, self.models.held(several), way, self._workers)
        self.models.miss(before, several, found, self._deadline)
        return self.models.add(before, several, way, found, {})

    def unfitted(self, before: FittedModel) -> tuple[str, ...]:
        """Return the candidates whose refits beside a model were broken off, as the time was over."""
        return tuple(sorted(self.models.unfitted.get(before.number, ())))

    def findings(self, model: FittedModel) -> Findings:
        """Test the innovations of a model."""
        return self.models.tested(model).findings

    def quiet_scores(self, model: FittedModel) -> tuple[Score, ...]:
        """Score candidates against a predictor with low process noise."""
        return self.models.quiet_scores(model)

    def equation_scores(self, model: FittedModel) -> tuple[Score, ...]:
        """Score candidates by what they take off the equation error of a model."""
        return self.models.equation_scores(model)

    def held_out(self, before: FittedModel, after: FittedModel) -> HeldOut:
        """Return what an effect gains where it was not estimated."""
        key = before.number, after.number
        if key not in self._held_out:
            _, refit = self.models.computed(before)
            self._held_out[key] = held_out_gains(refit, self.models.computed(after)[1])
        return self._held_out[key]

    def coloured(self, beside: FittedModel) -> FittedModel | None:
        """Return the base model with coloured noise, if the data are likelier with it, and may be than with another model."""
        if not self._coloured and self._deadline.over:
            self._broken_off.add("the colour of the noise")
            return None
        if not self._coloured:
            setting, base = self.models.computed(self.base)
            other = coloured(setting, base, self._workers, beside.log_likelihood)
            if other is None:
                self._coloured = [None]
            else:
                other, base = recoloured(other, fit_base(other))
                self._coloured = [self.models.record(other, base, None)]
        return self._coloured[0]

    def simulation(self, model: FittedModel) -> SimulationError:
        """Return the error of a free simulation of a model: of a base model that of the fit that is diagnosed."""
        if model.number not in self._simulations:
            setting, refit = self.models.computed(model)
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
            self.simulated.extend(before.number, *self.models.computed(before), self.models.held(several))
        found = {s.id: self.simulated.errors[before.number, s.id] for s in several}
        found = {effect: errors for effect, errors in found.items() if errors}
        self.models.miss(before, several, found, self._deadline)
        return found

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
            models=tuple(self.models.records),
            coloured=None if coloured is None else coloured.number,
            colour_asked=bool(self._coloured),
            refits=tuple(self.models.refits.values()),
            findings={number: tested.findings for number, tested in self.models.tests.items()},
            quiet=dict(self.models.quiet),
            held_out=dict(self._held_out),
            simulations=dict(self._simulations),
            policy=self.policy.as_dict(),
            equations=dict(self.models.equations),
            simulated=dict(self.simulated.errors),
            broken_off=self.broken_off,
            unfitted={number: tuple(sorted(several)) for number, several in self.models.unfitted.items() if several},
        )

    def _refits_from_simulation(self, before: FittedModel, several: Sequence[Score]) -> dict[str, FittedModel]:
        """Refit a model with each of several candidates from where a simulation with it ended, and keep that as the model's."""
        setting, refit = self.models.computed(before)
        fits: dict[str, Fit] = {}
        found: dict[str, Refit] = {}
        for s in self.models.held(several):
            fit = self.simulated.finish(before.number, s.id, setting)
            after = None if fit is None else self.simulated.predictor_from(fit, setting, refit, s)
            if fit is not None and after is not None:
                fits[s.id], found[s.id] = fit, after
        self.models.miss(before, several, found, self._deadline)
        models = self.models.add(before, several, "simulation", found, {})
        for effect, model in models.items():
            self.simulated.keep(model.number, fits[effect])
            self._simulations[model.number] = simulation_error(setting, fits[effect], found[effect])
        return models


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
