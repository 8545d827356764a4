"""Refitting: the predictor of the base model, and refits with candidates added or taken away."""

import contextlib
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import reduce
from typing import Any

import numpy as np

from estimators.core.compilation import Ahead
from estimators.core.data import CHANNELS
from estimators.core.fisher_information import information
from estimators.core.fit import Fit, Parameter
from estimators.core.levenberg_marquardt import Arguments, factor
from estimators.core.parameter_space import Space
from estimators.core.residual import start_rows
from estimators.core.results import NotIdentifiableError
from estimators.core.threads import at_once, threads
from estimators.diagnosis.contact_trials import (
    acting_on_arm,
    begins_of,
    climbed_by_trial,
    few_random_forces,
    in_turn,
    likeliest_begin,
)
from estimators.diagnosis.evidence import QUIET, Probing
from estimators.diagnosis.refit import Refit, Tested
from estimators.diagnosis.setting import begun, by_name, shared
from estimators.inference.simulation_residual import SimulationResidual, known_noise, random_forces_are_large
from estimators.misspecification.candidate_screening import Screened
from estimators.output_error.fit import output_error
from estimators.prediction_error.coloured_noise import ColouredNoise, Colours, likeliest_colours, rest_spectra
from estimators.prediction_error.noise_estimation import compile_predictor, fit_noise, fit_predictor, without_shaken
from estimators.validation.model_comparison import by_sample, held_out
from rtac_jax import RTAC
from rtac_jax.effects import Effect
from rtac_jax.measurement import Recording
from rtac_jax.parameters import declarations

_MEMORIES = (1.5, 4.0, 10.0, 25.0)  # correlation times of sensor noise that are tried, in samples
_QUIETER = 6.0  # by how much in the logarithm of their variance random forces are lowered for that
_WORTH = 10.0  # gain in log-likelihood for which coloured noise is taken instead of white
_SPOKEN = 4.5  # loss of the rest records' log-likelihood that is no chance: three standard deviations
_WORTH_MENDING = 0.5  # gain in log-likelihood for which a colour is changed
Way = Callable[[Refit, Screened], Refit]
"""To refit the model before with a candidate."""


class Search(Probing):
    """The fitted models of one diagnosis."""

    @classmethod
    def of(cls, fit: Fit, recording: Recording, classes: Sequence[type[Effect]], bar: Any) -> "Search":
        """Set up for the model of a fit."""
        return cls.set_up(fit.model, recording, classes, fit.start, int(fit.statistics["substeps"]), bar)

    @classmethod
    def compile_for(cls, model: RTAC, recording: Recording, classes: Sequence[type[Effect]]) -> None:
        """Compile what the diagnosis of a model will run first, so that this can be done while the model is fitted."""
        search = cls.set_up(model, recording, classes, {}, 1, None)
        for piece in search.pieces_of_tests():  # first: a fit begins with the filter too, and compiles it
            piece()
        search._compile_fit(search.with_effects([]), tuple(shared(model)))

    def compile_base(self) -> None:
        """Compile what `base` will run after the filter, which it begins with and compiles itself."""
        self._compile_fit(self.with_effects([]), tuple(shared(self.model)), noise=False)

    def base(self) -> Refit:
        """Fit the base model."""
        return self._fitted((), self.with_effects([]), tuple(shared(self.model)), None, {})

    def recoloured(self, base: Refit) -> "tuple[Search, Refit]":
        """Return the search with the noise colour that rest and motion make likeliest, and the base model fitted again.

        A rest record of a second or two leaves the correlation time open by a tenth or more, and motion shows that. What the
        model leaves out must not be taken for colour, so the colour stays where the rest records do not speak against it;
        without rest records only the reach of the search bounds it.
        """
        if self.colour is None:
            return self, base
        spectra = rest_spectra(self.recording.experiments)
        kept = {name: v for name, v in base.values.items() if name.split(".")[0] != ColouredNoise.id}
        noise = base.predictor.noise

        def likelihood(colours: Colours) -> float:
            rest = 0.0
            for channel, colour in colours.items():
                if channel in spectra:
                    lost = spectra[channel].log_likelihood(*first[channel]) - spectra[channel].log_likelihood(*colour)
                    if lost > _SPOKEN:
                        return -np.inf
                    rest -= lost
            trial = dataclasses.replace(self, colour=ColouredNoise.of(colours))
            model = trial.with_effects([]).with_values(kept)
            space = begun(trial.space(model, base.free), model, base.start)
            physical, prior = space.physical(space.unconstrained(start=False)), self.prior.starting(space)
            return rest + fit_noise(model, self.data, space, physical, prior, noise, self.substeps).log_likelihood

        first = self.colour.colours
        best, gained = likeliest_colours(first, likelihood)
        if not gained >= _WORTH_MENDING:
            return self, base
        search = dataclasses.replace(self, colour=ColouredNoise.of(best))
        model = search.with_effects([]).with_values(kept)
        refit = search._fitted((), model, base.free, noise, base.start)
        return (search, refit) if refit.predictor.log_likelihood > base.predictor.log_likelihood else (self, base)

    def trusting(self, base: Refit) -> "tuple[Search, Refit]":
        """Return the search, and the base model fitted again, where no stick-slip ambiguous sample counts.

        The samples are those of the base model, for all models: likelihoods compare only where they count the same
        data.
        """
        if not np.any(base.predictor.filtered.shaken):
            return self, base
        search = dataclasses.replace(self, data=without_shaken(self.data, base.predictor.filtered))
        model = base.model.with_values(base.values)
        return search, search._fitted((), model, base.free, base.predictor.noise, base.start)

    def with_effect(self, before: Refit, s: Screened) -> Refit:
        """Fit a model with one candidate more, all parameters together."""
        model, free, added = self._beginning(before, s)
        return self._fitted(added, model, free, before.predictor.noise, before.start)

    def thoroughly(self, before: Refit, s: Screened) -> Refit:
        """Return the likelier of `with_effect` and, for a contact, `by_trial`, or, for any other effect, `by_simulation`.

        Raises:
            ArithmeticError: the model diverges, or leaves parameters free, in both.
        """
        filtered = other = None
        with contextlib.suppress(ArithmeticError):
            filtered = self.with_effect(before, s)
        contact = self.classes[s.id].acts_by_contact
        with contextlib.suppress(ArithmeticError):
            other = self.by_trial(before, s) if contact else self.by_simulation(before, s, filtered)
        refits = [refit for refit in (filtered, other) if refit is not None]
        if not refits:
            raise FloatingPointError(f"with {s.id} the model diverges, wherever its refit begins.")
        return max(refits, key=lambda one: one.predictor.log_likelihood)

    def by_simulation(self, before: Refit, s: Screened, filtered: Refit | None) -> Refit:
        """Refit from where a free simulation ends.

        What swings fast misleads the start that the first samples show. The filter takes it for a large random torque, and the
        fit to its innovations ends there. So the refit begins again from parameters and starts with which a simulation follows
        the data, and from little random force. Simulations are fitted from the fit that is diagnosed, and from what the filter
        found: of what rings for long a simulation follows only what it has the frequency of, which the filter finds from
        farther away.

        Args:
            before: the model without the candidate.
            s: the candidate.
            filtered: the refit by the filter, if there is one.

        Raises:
            ArithmeticError: the model diverges, or leaves parameters free, from every simulation.
        """
        model, free, added = self._beginning(before, s)
        begins = [reduce(RTAC.__add__, [effect for effect in model.effects if effect.id in added], self.model)]
        if filtered is not None:
            known = {name: value for name, value in filtered.values.items() if name in begins[0].parameters}
            begins.append(begins[0].with_values(known))
        simulated = []
        for begin in begins:
            with contextlib.suppress(ArithmeticError, NotIdentifiableError):
                simulated.append(output_error(begin, self.recording, from_model=True, progress=False))
        for found in sorted(simulated, key=lambda found: found.statistics["cost"]):
            with contextlib.suppress(ArithmeticError):
                return self._from_simulation(before, added, model, free, found)
        raise FloatingPointError(f"with {s.id} the model diverges in a simulation.")

    def by_trial(self, before: Refit, s: Screened) -> Refit:
        """Refit what works by contact: trials of what moves it, a fit of all else, and a fit of all, in turn.

        When a contact begins and ends moves by whole samples as a parameter changes, so the likelihood has steps, and the
        derivative of the innovations says nothing of them: a fit alone ends a few percent from the truth, with random forces
        for what it does not follow. So trials begin with little of these, at the likeliest of many sizes and shapes.

        Raises:
            ArithmeticError: the model diverges, or leaves parameters free.
        """
        model, free, added = self._extended(before, s)
        model = model.with_values({n: v for n, v in before.values.items() if n in model.parameters})
        moving = acting_on_arm(model, free)
        others = tuple(name for name in free if name not in moving)

        def placed(values: Mapping[str, float], each: Any) -> Space:
            there = model.with_values(values)
            return dataclasses.replace(begun(self.space(there, moving), there, before.start), each_values=each)

        def climbed(space: Space, noise: np.ndarray, side: float) -> tuple[Space, np.ndarray]:
            return climbed_by_trial(
                model, self.data, space, self.prior.starting(space), noise, self.substeps, side=side
            )

        def fitted(space: Space, noise: np.ndarray) -> tuple[Refit, Space]:
            values = dict(zip(space.names, np.asarray(space.values).tolist(), strict=True))
            one = self._fitted(added, model.with_values(values), others, noise, before.start)
            refit = self._fitted(added, model.with_values(one.values), free, one.predictor.noise, before.start)
            return refit, placed(refit.values, refit.predictor.physical[1])

        begins = begins_of(s.instance, s.amplitudes)
        several = [placed({f"{s.id}.{n}": v for n, v in one.items()}, before.predictor.physical[1]) for one in begins]
        few = few_random_forces(before.predictor.noise)
        space = likeliest_begin(model, self.data, several, self.prior.starting(several[0]), few, self.substeps)
        return in_turn(space, before, climbed, fitted)

    def _from_simulation(
        self, before: Refit, added: tuple[str, ...], model: RTAC, free: tuple[str, ...], found: Fit
    ) -> Refit:
        values = {name: parameter.value for name, parameter in found.parameters.items()}
        noise = np.concatenate([np.minimum(before.predictor.noise[:2], QUIET), before.predictor.noise[2:]])
        start = np.stack([found.start[e.name] for e in self.experiments], axis=1)
        starts = dict(zip(start_rows(found.model), start, strict=True))
        return self._fitted(added, model.with_values(values), free, noise, starts)

    def stand_in(self, fit: Fit, final: Refit) -> SimulationResidual | None:
        """Return what the simulation of a model with effects added misses, where random forces stand in for the physics.

        An effect of the catalogue may take the best part of what another mistake leaves, and random forces the rest, so that
        nothing rejects any more. A simulation is fitted only where the random forces are large; where none can be, the one
        without the effects says what is known.

        Args:
            fit: that is diagnosed.
            final: the predictor of the model with the effects.

        Returns:
            None where the random forces are modest, no noise is known, or the simulation follows.
        """
        random = (final.predictor.random_force, final.predictor.random_torque)
        known = known_noise(self.recording) & set(fit.residual_std)
        if not known or not random_forces_are_large(random, self.samples_per_radian):
            return None
        self.bar.set_description("diagnose: simulation with what was added")
        extended = reduce(RTAC.__add__, [self.effect(i, final) for i in final.added], fit.model)
        extended = extended.with_values({n: v for n, v in final.values.items() if n in extended.parameters})
        try:
            simulated = output_error(extended, self.recording, from_model=True, progress=False)
            found = self.simulation(simulated, final, ())
        except (ArithmeticError, NotIdentifiableError):
            found = self.simulation(fit, final, ())
        return found if found.cause == "stand-in" else None

    def without(self, refit: Refit, effect: str) -> Refit:
        """Fit a model with one of its added effects less, all parameters together."""
        added = tuple(i for i in refit.added if i != effect)
        model = self.with_effects([e for i, e in self.absent.items() if i in added])
        model = model.with_values({n: v for n, v in refit.values.items() if n in model.parameters})
        free = tuple(name for name in refit.free if name.split(".")[0] != effect)
        return self._fitted(added, model, free, refit.predictor.noise, refit.start)

    def refitted(self, before: Refit, s: Screened, way: Way | None = None) -> Refit | None:
        """Fit a model with one candidate more, by default `with_effect`; None if the model diverges with it."""
        self.bar.set_description(f"diagnose: refit with {s.id}")
        with contextlib.suppress(ArithmeticError, NotIdentifiableError):
            return (way or self.with_effect)(before, s)
        return None

    def refits(self, before: Refit, several: Sequence[Screened], way: Way | None = None) -> dict[str, Refit]:
        """Refit with each of several candidates, but for those with which the model diverges."""
        return _refits(several, at_once(lambda s: self.refitted(before, s, way), several))

    def first_refits(
        self, before: Refit, first: Screened, near: Sequence[Screened], way: Way | None = None
    ) -> tuple[dict[str, Refit], Tested | None]:
        """Refit with the first candidate and those near it, and test the first.

        Its tests are compiled while it is fitted, the others fitted while it is tested.
        """
        _, free, added = self._extended(before, first)
        with ThreadPoolExecutor(threads() - 1) as pool:
            code = Ahead(pool, self.pieces_of_tests(added, free))
            begun = [pool.submit(self.refitted, before, s, way) for s in near]
            try:
                refit = self.refitted(before, first, way)
                tested = None if refit is None else self.tested(refit, code)
                # What no other thread has begun is done here, the last first, so that the two meet.
                here = {
                    s.id: self.refitted(before, s, way)
                    for s, one in reversed(list(zip(near, begun, strict=True)))
                    if one.cancel()
                }
                found = [here[s.id] if s.id in here else one.result() for s, one in zip(near, begun, strict=True)]
            finally:
                pool.shutdown(wait=False, cancel_futures=True)
        return _refits([first, *near], [refit, *found]), tested

    def coloured(self, base: Refit) -> "Search | None":
        """Return the search with coloured sensor noise, if that makes the base model's data more likely; else None.

        Rest records would tell; without them the likelihood has to.
        """
        count = np.asarray(self.data.present).sum(axis=(0, 2))
        memories = np.unique(np.outer(np.unique(np.asarray(self.data.excitation.sample_time)), _MEMORIES))
        best, likelihood = {}, base.predictor.log_likelihood
        for channel in np.array(CHANNELS)[count > 0]:
            trials = [{**best, str(channel): (1.0, float(memory))} for memory in memories]
            values = at_once(lambda colours: self._likelihood_with(colours, base), trials)
            for trial, value in zip(trials, values, strict=True):
                if value > likelihood + _WORTH:
                    likelihood, best = value, trial
        return dataclasses.replace(self, colour=ColouredNoise.of(best)) if best else None

    def _likelihood_with(self, colours: Colours, base: Refit) -> float:
        """Return the log-likelihood of the base model with coloured noise."""
        trial = dataclasses.replace(self, colour=ColouredNoise.of(colours))
        model = trial.with_effects([])
        space = trial.space(model, base.free)
        space = dataclasses.replace(space, values=by_name(space, base.space, base.predictor.physical[0]))
        physical = space.physical(space.unconstrained(start=False))
        prior = self.prior.starting(space)
        # Random forces may stand for what is colour: so from without them, too.
        quiet = np.concatenate([base.predictor.noise[:2] - _QUIETER, base.predictor.noise[2:]])
        return max(
            fit_noise(model, self.data, space, physical, prior, noise, self.substeps).log_likelihood
            - space.penalty(physical[0])
            for noise in (base.predictor.noise, quiet)
        )

    def held_out_gain(self, before: Refit, after: Refit) -> float:
        """Return the gain in the log-likelihood of experiments that did not take part in estimating the effect.

        NaN if none can tell.
        """
        added = [place for place, name in enumerate(after.free) if name not in before.free]
        change = held_out(after.triangles, len(after.predictor.unknowns.shared), added)
        gains = np.asarray(after.predictor.filtered.log_likelihood) - np.asarray(
            before.predictor.filtered.log_likelihood
        )
        known = np.isfinite(change)
        return float(np.sum(gains[known] + change[known])) if known.any() else np.nan

    def parameters(self, effect: str, refit: Refit) -> dict[str, Parameter]:
        """Return the parameters of an added effect with standard deviations."""
        found = refit.predictor
        known = information(refit.triangles, refit.space, found.unknowns)
        deviations = dict(zip(known.names, np.sqrt(np.diagonal(known.covariance)), strict=True))
        return {
            name.split(".")[1]: Parameter(
                float(value), float(deviations.get(name, 0.0)), refit.model.parameters[name].unit
            )
            for name, value in refit.values.items()
            if name.split(".")[0] == effect
        }

    def loose(self, effect: str, refit: Refit) -> bool:
        """Return whether the data leave a parameter of an added effect free."""
        known = information(refit.triangles, refit.space, refit.predictor.unknowns)
        return any(f"{effect}." in said for said in known.undetermined())

    def _compile_fit(self, model: RTAC, free: Sequence[str], *, noise: bool = True) -> None:
        space = self.space(model, free)
        compile_predictor(model, self.data, space, self.prior.starting(space), self.substeps, noise=noise)

    def _beginning(self, before: Refit, s: Screened) -> tuple[RTAC, tuple[str, ...], tuple[str, ...]]:
        """Return a model with one candidate more where its refit begins.

        Returned beside it are its free parameters, and the ids of what was added to the base model.
        """
        declared = declarations(s.instance)
        values = before.values
        for name in declared:
            start = float(np.asarray(getattr(s.instance, name)))
            if name in s.amplitudes:
                begin = float(s.begin[s.amplitudes.index(name)])
                plausible = abs(start)
                start = float(np.sign(begin) * np.clip(abs(begin), 0.05 * plausible, 20 * plausible))
                start = start or 0.05 * plausible
            values[f"{s.id}.{name}"] = start
        model, free, added = self._extended(before, s)
        return model.with_values({n: v for n, v in values.items() if n in model.parameters}), free, added

    def _extended(self, before: Refit, s: Screened) -> tuple[RTAC, tuple[str, ...], tuple[str, ...]]:
        """Return a model with one candidate more at null, its free parameters, and the ids of what was added."""
        added = (*before.added, s.id)
        declared = declarations(s.instance)
        model = self.with_effects([effect for i, effect in self.absent.items() if i in added])
        free = before.free + tuple(f"{s.id}.{n}" for n in declared if not declared[n].fixed)
        return model, free, added

    def _fitted(
        self,
        added: tuple[str, ...],
        model: RTAC,
        free: tuple[str, ...],
        noise: np.ndarray | None,
        start: Mapping[str, np.ndarray],
    ) -> Refit:
        def show(text: str) -> None:
            self.bar.update(1)
            self.bar.set_postfix_str(text, refresh=False)

        space = begun(self.space(model, free), model, start)
        prior = self.prior.starting(space)
        found = fit_predictor(model, self.data, space, prior, substeps=self.substeps, first=noise, progress=show)
        arguments = Arguments(model, self.data, space, found.filtered.whitener, found.filtered.gain, self.substeps)
        triangles = np.asarray(factor(found.unknowns, arguments))
        return Refit(added, model, found, space, by_sample(found.filtered), free, triangles)


def _refits(several: Sequence[Screened], found: Sequence[Refit | None]) -> dict[str, Refit]:
    return {s.id: refit for s, refit in zip(several, found, strict=True) if refit is not None}
