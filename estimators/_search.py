"""The work of a diagnosis: predictor of the base model, tests of its innovations, refits with candidates added."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import reduce
from typing import Any

import jax.numpy as jnp
import numpy as np

from estimators._adequacy import evidence
from estimators._can_show import can_show
from estimators._coloured_noise import ColouredNoise, colours_at_rest
from estimators._covariance import information
from estimators._delayed_force import delayed_forces
from estimators._force_curve import compile_force_curves, force_curves
from estimators._innovations import Innovations, Rows, orthonormal, stretches
from estimators._latent_force import LatentForce, latent_forces
from estimators._levenberg_marquardt import Arguments, factor
from estimators._likelihood import NoiseModel, compile_predictor, fit_noise, fit_predictor, run_filter
from estimators._line_classes import LineClass, line_classes
from estimators._noise import noise_levels
from estimators._output_error import Fit, Parameter, moving, output_error, pieces
from estimators._problem import CHANNELS, Data, Space, start_rows
from estimators._refit import Refit, Tested
from estimators._repeats import repeat_test
from estimators._results import NotIdentifiableError
from estimators._screen import Screened, screen
from estimators._selection import by_sample, held_out
from estimators._spectral_line import spectral_line
from estimators._start import scales_of, space_of
from estimators._where import Place, where
from rtac_jax import RTAC
from rtac_jax._parameter import declarations
from rtac_jax._simulate import Steps
from rtac_jax.effects import Effect
from rtac_jax.measurement import Experiment, Recording

_SLOW = 1e-2  # share of the rms speed below which a learned friction fades
_ROOM = 16  # unknowns are padded to a multiple of this
_MEMORIES = (1.5, 4.0, 10.0, 25.0)  # correlation times of sensor noise that are tried, in samples
_QUIETER = 6.0  # by how much in the logarithm of their variance random forces are lowered for that
_QUIET = np.log(1e-3**2)  # variance of random forces, in shares of the rms forces, where they should not hide an effect
_WORTH = 10.0  # gain in log-likelihood for which coloured noise is taken instead of white


@dataclasses.dataclass
class Search:
    """What stays the same over one diagnosis: the data, and the candidates at null.

    Screening simulates one model with all candidates at null; the filter, which costs the cube of the number of states, runs
    on models with no more than what was added.
    """

    model: RTAC
    recording: Recording
    absent: dict[str, Effect]
    colour: ColouredNoise | None
    colour_seen: bool
    experiments: list[Experiment]
    data: Data
    prior: NoiseModel
    classes: dict[str, type[Effect]]
    instances: list[Effect]
    substeps: Steps
    start: dict[str, np.ndarray]
    bar: Any

    @classmethod
    def of(cls, fit: Fit, recording: Recording, classes: Sequence[type[Effect]], bar: Any) -> "Search":
        """Set up for the model of a fit; candidates that nothing in the recording could show are passed over."""
        return cls._set_up(fit.model, recording, classes, fit.start, int(fit.statistics["substeps"]), bar)

    @classmethod
    def compile_for(cls, model: RTAC, recording: Recording, classes: Sequence[type[Effect]]) -> None:
        """Compile what the diagnosis of a model will run first, so that this can be done while the model is fitted."""
        search = cls._set_up(model, recording, classes, {}, 1, None)
        search.compile_tests()  # first: a fit begins with the filter too, and compiles it
        search._compile_fit(search._with([]), tuple(_shared(model)))

    @classmethod
    def _set_up(
        cls,
        model: RTAC,
        recording: Recording,
        classes: Sequence[type[Effect]],
        starts: Mapping[str, np.ndarray],
        substeps: int,
        bar: Any,
    ) -> "Search":
        experiments = pieces(moving(recording))
        scales = scales_of(model, experiments)
        possible: dict[str, type[Effect]] = {}
        instances: list[Effect] = []
        absent: dict[str, Effect] = {}
        for c in classes:
            found = c.candidates(scales)
            if found and can_show(c, experiments):
                possible[c.id] = c
                instances += list(found)
                absent[c.id] = _absent_like(found[len(found) // 2])
        levels = dict(noise_levels(recording.experiments))
        colours = colours_at_rest(recording.experiments)
        # The first samples tell the start better than a simulation of a model that may be wrong, except for an angle
        # that nobody measured.
        blind = [e for e in experiments if e.initial_arm_angle is None and "arm_angle" not in e.outputs]
        start = {e.name: starts[e.name] for e in blind if e.name in starts}
        space = space_of(model, experiments, free=_shared(model), start=start)
        prior = NoiseModel.of(levels, recording.experiments, scales, space)
        colour = ColouredNoise.of(colours) if colours else None
        return cls(
            model, recording, absent, colour, colour is not None, experiments, Data.of(experiments), prior, possible, instances,
            jnp.asarray(substeps), start, bar,
        )  # fmt: skip

    @property
    def assumed(self) -> tuple[str, ...]:
        """Channels whose noise was taken as coloured although no rest record shows it."""
        if self.colour is None or self.colour_seen:
            return ()
        return tuple(str(c) for c in np.array(CHANNELS)[np.asarray(self.colour.share) > 0])

    @property
    def samples(self) -> int:
        """Number of measured values."""
        return int(np.sum(np.asarray(self.data.present)))

    def base(self) -> Refit:
        """The base model."""
        return self._fitted((), self._with([]), tuple(_shared(self.model)), None, {})

    def compile_tests(self) -> None:
        """Compile what tests of innovations will run, so that another thread can do so while the base model is fitted."""
        self._unfitted(self._with(list(self.absent.values())), _shared(self.model)).compile()
        self._compile_probes(self._with([]), _shared(self.model))

    @contextlib.contextmanager
    def refitting(
        self, before: Refit, several: Sequence[Screened], *, simulated: bool = False
    ) -> Iterator[Callable[[Screened], Refit | None]]:
        """`with_effect` for several candidates; while one is fitted, the code of the next is compiled.

        None for a candidate with which the model diverges. `simulated`: as `from_simulation` where that is more likely.
        """
        with ThreadPoolExecutor(1) as other:
            ready = {}
            for s in several:
                model, free, _ = self._extended(before, s)
                ready[s.id] = other.submit(self._compile_fit, model, free)
                if s is several[0]:
                    other.submit(self._compile_probes, model, free)

            def refitted(s: Screened) -> Refit | None:
                self.bar.set_description(f"diagnose: refit with {s.id}")
                wait([ready[s.id]])  # what could not be compiled there is compiled here
                found = []
                for refit in (self.with_effect, self.from_simulation) if simulated else (self.with_effect,):
                    with contextlib.suppress(ArithmeticError, NotIdentifiableError):
                        found.append(refit(before, s))
                return max(found, key=lambda refit: refit.predictor.log_likelihood, default=None)

            yield refitted

    def _compile_fit(self, model: RTAC, free: Sequence[str]) -> None:
        space = self._space(model, free)
        compile_predictor(model, self.data, space, self.prior.starting(space), self.substeps)

    def _compile_probes(self, model: RTAC, free: Sequence[str]) -> None:
        innovations = self._unfitted(model, free)
        innovations.compile_derivatives()
        compile_force_curves(innovations)

    def _unfitted(self, model: RTAC, free: Sequence[str]) -> Innovations:
        """Innovations for compiling only: the shapes are right, gains and whiteners are nothing."""
        gain, whitener = (
            jnp.asarray(np.zeros((self.data.samples, count, len(CHANNELS), self.data.experiments)))
            for count in (len(model.states), len(CHANNELS))
        )
        return Innovations(model, self.data, self._padded(model, free), whitener, gain, self.substeps)

    def held_out_gain(self, before: Refit, after: Refit) -> float:
        """Gain in the log-likelihood of experiments that did not take part in estimating the effect; NaN if none can tell."""
        added = [place for place, name in enumerate(after.free) if name not in before.free]
        change = held_out(after.triangles, len(after.predictor.unknowns.shared), added)
        gains = np.asarray(after.predictor.filtered.log_likelihood) - np.asarray(
            before.predictor.filtered.log_likelihood
        )
        known = np.isfinite(change)
        return float(np.sum(gains[known] + change[known])) if known.any() else np.nan

    def coloured(self, base: Refit) -> "Search | None":
        """The same with coloured sensor noise, if that makes the data of the base model more likely; None otherwise.

        Rest records would tell; without them the likelihood has to.
        """
        count = np.asarray(self.data.present).sum(axis=(0, 2))
        interval = float(np.min(np.asarray(self.data.excitation.sample_time)))
        best, likelihood = {}, base.predictor.log_likelihood
        for channel in np.array(CHANNELS)[count > 0]:
            for memory in interval * np.array(_MEMORIES):
                trial = dataclasses.replace(self, colour=ColouredNoise.of({**best, str(channel): (1.0, float(memory))}))
                model = trial._with([])
                space = trial._space(model, base.free)
                space = dataclasses.replace(space, values=_by_name(space, base.space, base.predictor.physical[0]))
                physical = space.physical(space.unconstrained(start=False))
                prior = self.prior.starting(space)
                # Random forces may stand for what is colour: so from without them, too.
                quiet = np.concatenate([base.predictor.noise[:2] - _QUIETER, base.predictor.noise[2:]])
                value = max(
                    fit_noise(model, self.data, space, physical, prior, noise, self.substeps).log_likelihood
                    for noise in (base.predictor.noise, quiet)
                )
                if value > likelihood + _WORTH:
                    likelihood, chosen = value, (1.0, float(memory))
                    best = {**best, str(channel): chosen}
        return dataclasses.replace(self, colour=ColouredNoise.of(best)) if best else None

    def with_effect(self, before: Refit, s: Screened) -> Refit:
        """A model with one candidate more, all parameters fitted together."""
        model, free, added = self._beginning(before, s)
        return self._fitted(added, model, free, before.predictor.noise, before.start)

    def from_simulation(self, before: Refit, s: Screened) -> Refit:
        """The same from parameters and starts with which a free simulation follows the data, and from little random force.

        What works by contact or play has no derivative by which a filter could follow it, and what swings fast misleads the
        start that the first samples show. The filter takes either for a large random torque, and the fit to its innovations
        ends there.

        Raises:
            ArithmeticError: the model diverges.
            NotIdentifiableError: the data leave parameters of the simulation free.
        """
        model, free, added = self._beginning(before, s)
        simulated = reduce(RTAC.__add__, [effect for effect in model.effects if effect.id in added], self.model)
        found = output_error(simulated, self.recording, from_model=True, progress=False)
        values = {name: parameter.value for name, parameter in found.parameters.items()}
        noise = np.concatenate([np.minimum(before.predictor.noise[:2], _QUIET), before.predictor.noise[2:]])
        start = np.stack([found.start[e.name] for e in self.experiments], axis=1)
        begun = dict(zip(start_rows(found.model), start, strict=True))
        return self._fitted(added, model.with_values(values), free, noise, begun)

    def _beginning(self, before: Refit, s: Screened) -> tuple[RTAC, tuple[str, ...], tuple[str, ...]]:
        """A model with one candidate more where its refit begins, its free parameters, and what was added to the base model."""
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

    def without(self, refit: Refit, effect: str) -> Refit:
        """A model with one of its added effects less, all parameters fitted together."""
        added = tuple(i for i in refit.added if i != effect)
        model = self._with([e for i, e in self.absent.items() if i in added])
        model = model.with_values({n: v for n, v in refit.values.items() if n in model.parameters})
        free = tuple(name for name in refit.free if name.split(".")[0] != effect)
        return self._fitted(added, model, free, refit.predictor.noise, refit.start)

    def _extended(self, before: Refit, s: Screened) -> tuple[RTAC, tuple[str, ...], tuple[str, ...]]:
        """A model with one candidate more at null, its free parameters, and what was added to the base model."""
        added = (*before.added, s.id)
        declared = declarations(s.instance)
        model = self._with([effect for i, effect in self.absent.items() if i in added])
        free = before.free + tuple(f"{s.id}.{n}" for n in declared if not declared[n].fixed)
        return model, free, added

    def parameters(self, effect: str, refit: Refit) -> dict[str, Parameter]:
        """Parameters of an added effect with standard deviations."""
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

    def effect(self, effect: str, refit: Refit) -> Effect:
        """An added effect at its estimated parameters."""
        cls = self.classes[effect]
        return cls(**{name: refit.values[f"{effect}.{name}"] for name in declarations(cls)})

    def loose(self, effect: str, refit: Refit) -> bool:
        """Whether the data leave a parameter of an added effect free."""
        known = information(refit.triangles, refit.space, refit.predictor.unknowns)
        return any(f"{effect}." in said for said in known.undetermined())

    def stretches(self) -> np.ndarray:
        """For every sample and experiment the number of the second that it belongs to."""
        return stretches(self.data)

    def tested(self, refit: Refit) -> Tested:
        """Everything that the innovations of a model are asked."""
        probed = self._innovations(refit, [], refit.free)
        basis = orthonormal(probed.jacobian())
        screened, raw = self._screened(refit, basis)
        error = raw - basis @ (basis.T @ raw)
        scales = scales_of(self.model, self.experiments)
        slow = (_SLOW * scales.velocity, _SLOW * scales.arm_velocity)
        curves = force_curves(probed, error, basis, self._ranges(), slow)
        stiffness = float(np.asarray(self.model.body.spring_stiffness))
        delayed = delayed_forces(
            probed, error, basis, self.experiments, frequency=scales.frequency, stiffness=stiffness
        )  # fmt: skip
        whitened, present = self._told(refit)
        line = spectral_line(whitened, present, self.experiments)
        repeats = repeat_test(whitened, present, self.experiments)
        return Tested(tuple(screened), tuple(curves), evidence(screened, curves, delayed, line, repeats))

    def quietly(self, refit: Refit) -> list[Screened]:
        """Candidates held against a predictor that allows for little random force.

        Random forces that stand for a missing effect make the predictor follow the sensors, and hide from it what moves
        slowly beside the samples. Such statistics only rank: the innovations are not white.
        """
        found = refit.predictor
        noise = np.concatenate([np.minimum(found.noise[:2], _QUIET), found.noise[2:]])
        prior = self.prior.starting(refit.space)
        passed = run_filter(refit.model, self.data, refit.space, found.physical, prior, noise, self.substeps).filtered
        quiet = dataclasses.replace(refit, predictor=dataclasses.replace(found, noise=noise, filtered=passed))
        basis = orthonormal(self._innovations(quiet, [], quiet.free).jacobian())
        return self._screened(quiet, basis)[0]

    def _screened(self, refit: Refit, basis: Rows) -> tuple[list[Screened], np.ndarray]:
        """Candidates that were not added against the innovations, and these."""
        left = {i: effect for i, effect in self.absent.items() if i not in refit.added}
        innovations = self._innovations(refit, list(left.values()), refit.free)
        placed = innovations.space
        raw = innovations.at(np.asarray(placed.values)[None])[:, 0]

        def place(instance: Effect, amplitude: str) -> np.ndarray:
            values = np.asarray(placed.values).copy()
            for name, declared in declarations(instance).items():
                full = f"{instance.id}.{name}"
                if declared.null is None or name == amplitude:
                    values[placed.names.index(full)] = float(np.asarray(getattr(instance, name)))
            return values

        return screen(innovations, raw, basis, [i for i in self.instances if i.id in left], place), raw

    def places(self, refit: Refit) -> tuple[Place, ...]:
        """Where the innovations are too large."""
        whitened, present = self._told(refit)
        return tuple(where(whitened, present, self.experiments))

    def lines(self, refit: Refit) -> tuple[LineClass, ...]:
        """Innovations by class of spectral line."""
        whitened, present = self._told(refit)
        return tuple(line_classes(whitened, present, self.experiments))

    def latent(self, refit: Refit) -> tuple[LatentForce, ...]:
        """The missing force in time."""
        probed = self._innovations(refit, [], [])
        scales = scales_of(self.model, self.experiments)
        physical = (probed.space.values, refit.predictor.physical[1], probed.space.start)
        return latent_forces(
            probed.model, self.data, probed.space, physical, probed.gain,
            self.substeps, self.experiments,
            sensor_variance=np.exp(refit.predictor.noise[2:]) * self.prior.sensor**2,
            force=scales.force, torque=scales.torque, frequency=scales.frequency,
        )  # fmt: skip

    # -- parts -------------------------------------------------------------------------------------------------------

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

        space = _begun(self._space(model, free), model, start)
        prior = self.prior.starting(space)
        found = fit_predictor(model, self.data, space, prior, substeps=self.substeps, first=noise, progress=show)
        arguments = Arguments(model, self.data, space, found.filtered.whitener, found.filtered.gain, self.substeps)
        triangles = np.asarray(factor(found.unknowns, arguments))
        return Refit(added, model, found, space, by_sample(found.filtered, self.data), free, triangles)

    def _with(self, effects: Sequence[Effect]) -> RTAC:
        return reduce(RTAC.__add__, [*effects, *([self.colour] if self.colour is not None else [])], self.model)

    def _space(self, model: RTAC, free: Sequence[str]) -> Space:
        return space_of(model, self.experiments, free=free, start=self.start)

    def _padded(self, model: RTAC, free: Sequence[str]) -> Space:
        """With places past the end, so that a model with a few parameters more needs no new compilation."""
        space = self._space(model, free)
        active = np.full(-(-(len(free) + _ROOM) // _ROOM) * _ROOM, len(space.names))
        active[: len(space.active)] = np.asarray(space.active)
        return dataclasses.replace(space, active=jnp.asarray(active))

    def _innovations(self, refit: Refit, absent: Sequence[Effect], free: Sequence[str]) -> Innovations:
        """Innovations of a fitted model with some of the candidates beside what was added, and no others."""
        added = [effect for i, effect in self.absent.items() if i in refit.added]
        model = self._with([*added, *absent])
        space = self._padded(model, free)
        predictor = refit.predictor
        space = _begun(space, model, refit.start)
        space = dataclasses.replace(space, values=_by_name(space, refit.space, predictor.physical[0]))
        # A state that the filter does not know is not corrected.
        gain = np.asarray(predictor.filtered.gain)
        rows = {name: gain[:, i] for i, name in enumerate(refit.model.states)}
        nothing = np.zeros_like(gain[:, 0])
        placed = jnp.asarray(np.stack([rows.get(name, nothing) for name in model.states], axis=1))
        sure = 1.0 - predictor.filtered.shaken[:, None, None]
        return Innovations(model, self.data, space, predictor.filtered.whitener * sure, placed, self.substeps)

    def _told(self, refit: Refit) -> tuple[np.ndarray, np.ndarray]:
        """Innovations, and where there are any, but for samples at which dry friction is shaken loose.

        There the model's own rest is in doubt, and what it predicts says nothing of what it lacks.
        """
        filtered = refit.predictor.filtered
        sure = 1.0 - np.asarray(filtered.shaken)[:, None]
        return np.asarray(filtered.innovations) * sure, np.asarray(self.data.present) * sure

    def _ranges(self) -> dict[str, tuple[float, float]]:
        """Between which values each variable moves."""

        def between(values: list[np.ndarray]) -> tuple[float, float]:
            if not values:
                return 0.0, 0.0
            low, high = np.nanquantile(np.concatenate(values), [0.001, 0.999])
            return float(low), float(high)

        def outputs(channel: str) -> list[np.ndarray]:
            return [e.outputs[channel].values for e in self.experiments if channel in e.outputs]

        scales = scales_of(self.model, self.experiments)
        reach = 2.5 * scales.velocity if outputs("cart_position") else 0.0
        arm = any(e.arm == "free" for e in self.experiments)
        return {
            "cart_position": between(outputs("cart_position")),
            "cart_velocity": (-reach, reach),
            "arm_angle": (-np.pi, np.pi) if arm else (0.0, 0.0),
            "arm_velocity": between(outputs("arm_velocity")) if arm else (0.0, 0.0),
            "current": between([e.inputs["current"].values for e in self.experiments if "current" in e.inputs]),
        }


def _by_name(space: Space, other: Space, values: Any) -> Any:
    """Values of one space where another has a parameter of that name."""
    known = dict(zip(other.names, np.asarray(values), strict=True))
    return jnp.asarray([known.get(n, v) for n, v in zip(space.names, np.asarray(space.values), strict=True)])


def _begun(space: Space, model: RTAC, start: Mapping[str, np.ndarray]) -> Space:
    """With states at the start where they are known by name."""
    known = zip(start_rows(model), np.asarray(space.start), strict=True)
    return dataclasses.replace(space, start=jnp.asarray(np.stack([start.get(row, first) for row, first in known])))


def _shared(model: RTAC) -> list[str]:
    return [name for name in model.free if name not in model.per_experiment]


def _absent_like(instance: Effect) -> Effect:
    """The effect at its null value with the shape of an instance."""
    shape = {
        name: float(np.asarray(getattr(instance, name)))
        for name, declared in declarations(instance).items()
        if declared.null is None
    }
    return type(instance).absent(**shape)
