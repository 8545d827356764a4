"""The descent of output error from one start: by guided predictions to the free simulation, channels weighted by what is left."""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from estimators.core.active_bounds import OFF_BOUNDS, solve_bounded
from estimators.core.compilation import compile_beside
from estimators.core.concentrated_noise import ConcentratedNoise
from estimators.core.data import Data, in_channels, motion_of
from estimators.core.fisher_information import information
from estimators.core.fit import FAR
from estimators.core.initial_angle import angle_unknown
from estimators.core.initial_rest import at_rest, best_starts, may_swing, squares
from estimators.core.initial_state import scales_of, space_of
from estimators.core.jacobian_factor import Arguments, Passes, diverged, factor
from estimators.core.levenberg_marquardt import NEGLIGIBLE, Solved
from estimators.core.parameter_space import Space, Unknowns
from estimators.core.progress import Progress
from estimators.core.start_search import beyond_noise, searched
from estimators.core.step_size import accurate_substeps
from estimators.output_error.correction import correction
from estimators.output_error.free_simulation import FreeSimulation
from estimators.output_error.horizons import horizons
from estimators.output_error.robust import Robust
from estimators.output_error.robust import robust as robust_fit
from rtac_jax import RTAC
from rtac_jax.measurement import Experiment

# Random force and torque of the predictor, as fractions of the rms ones: from strong to weak correction.
_CORRECTION = (0.3, 0.03)
# A start is led to the simulation by predictions with correction, unless its simulation leaves less than so many times the
# noise of every channel or, where its values were given, this fraction of the motion: predictions hardly show a mode near its
# true frequency, which simulations do. From ten modes 1 to 20 % off in frequency, whose simulations left 4 to 24 % of the motion,
# the simulation led to the true one each time, predictions 4 times. With an effect missing either may be left behind by the other.
_NEAR_NOISE, _NEAR_MOTION = 5.0, 0.25
# An experiment begins at rest where that leaves less than this fraction of what is left from where its first samples begin.
_AT_REST = 0.5
# An arm whose angle nobody tells is begun elsewhere where that leaves less than this fraction of an experiment's squares.
_TURNED = 0.95
# Steps by the simulation from values that were given, after which one that is still far from the data is led by predictions.
_UNLED_STEPS = 20
# Parts of the data that are simulated first, each longer, where the simulation of all of an experiment leaves _NEAR_MOTION of its
# motion, as where an arm turns over: of twelve such fits four met the data without these, and all with them.
_PARTS = (16, 4, 2)
# A start whose short predictions stay this many times worse than another's is given up.
_HOPELESS = 5.0
# Sensitivities of a start that all but diverges, whose squares would be no numbers.
_SQUARED = 1e150
# A start leads where another one did if, once both were guided, the rms of what sets their simulations apart is less than this
# many times the noise of every sensor, so that no measurement could tell them from each other, or this many times what the other
# one ended at: of a rig whose spring had softened two such were 0.06 to 0.19 of that apart, and led to the same end in 60 passes.
_ALIKE = 0.3
_STAGE = 15  # passes of a stage that only makes a start for the next
# Gain in log-likelihood for which a stage that only makes a start for the next takes no further step; where a start that was
# guided is held against another's, both have to be nearer to where they lead.
_START, _GUIDANCE = 1.0, 1e-2


@dataclasses.dataclass(frozen=True)
class DescentEnd:
    """The end of a descent.

    Attributes:
        model: whose parameters were free, at the values where the descent began.
        space: of the unknowns.
        solved: the last of its problems.
        deviation: rms of each channel's residual.
        cost: negative log-likelihood with the noise levels at their best values, less a constant.
        substeps: Runge-Kutta steps per sample.
    """

    model: RTAC
    space: Space
    solved: Solved
    deviation: np.ndarray
    cost: float
    substeps: int

    def is_far(self, noise: Float[np.ndarray, " output"]) -> bool:
        """Return whether it leaves a channel so far from its noise that the model does not follow the rig."""
        return bool(np.any(self.deviation > FAR * noise))


@dataclasses.dataclass
class Descent:
    """The descent from each of several starts, and what is the same for all of them.

    Attributes:
        data, experiments: that are fitted.
        levels: noise of each channel, SI units.
        tolerance, steps: as `output_error` takes them.
        progress: that is told of every step.
        taken: steps that all descents took.
        nearest: least cost of guided predictions so far.
        followed: what each descent simulated once it was guided, and where it ended.
    """

    data: Data
    experiments: Sequence[Experiment]
    levels: Mapping[str, float]
    tolerance: float
    steps: int
    progress: Progress
    taken: int = 0
    nearest: float = np.inf
    followed: list[tuple[np.ndarray, DescentEnd]] = dataclasses.field(default_factory=list)

    def descend(
        self, model: RTAC, *, best: float, given: bool = False, led: bool = True,
        start: Mapping[str, np.ndarray] | None = None,
    ) -> DescentEnd | None:  # fmt: skip
        """Descend from predictions with strong correction to the free simulation; None where that leads nowhere.

        Where the guided start simulates what that of an earlier descent did, the rest would be the same: its end is returned.

        Args:
            model: at whose values the descent begins.
            best: least cost of the descents before.
            given: whether somebody gave these values, and did not find them in closed form.
            led: whether predictions lead on where the steps from values that were given end before the descent does, and short
                parts of the data where these lead to no simulation that follows.
            start: states at the start by experiment; by default what the first samples show.
        """
        free = [n for n in model.free if n not in model.per_experiment]
        space = space_of(model, self.experiments, free=free, start=start)
        unknowns = space.unconstrained(off_bounds=OFF_BOUNDS)
        noise = self.noise
        simulation = FreeSimulation(model, self.data, space, noise)
        # While what only simulates, and the filter, are compiled here.
        passes = Passes(simulation.arguments())
        compile_beside(lambda: passes.prepare(unknowns))
        substeps = accurate_substeps(model, self.data, space, unknowns, noise)
        simulation = dataclasses.replace(simulation, substeps=substeps)
        if may_swing(model):
            unknowns = best_starts([unknowns, at_rest(unknowns, space)], simulation.arguments(), worth=_AT_REST)
        parts = horizons(simulation.arguments(), unknowns)
        begun = simulation.error(unknowns)
        deviation = simulation.rms(begun)
        # A start whose free simulation is near already, as after adding what a diagnosis found, needs no guidance.
        if np.all(deviation < _NEAR_NOISE * noise):
            return self._ended(simulation, unknowns, best)
        end = None
        if given and np.all(deviation < np.maximum(_NEAR_NOISE * noise, _NEAR_MOTION * motion_of(self.data))):
            end = self._ended(simulation, unknowns, best, most=_UNLED_STEPS if led else None)
            if not led:
                return end
            if not end.solved.converged and not end.is_far(noise):
                end = self._weighted(self._simulation(end), end.solved.unknowns, end.deviation, best)
                self.followed.append((begun, end))
            if end.solved.converged:
                return end
        guided = self._guided(simulation, unknowns, parts)
        if guided is None:
            return end
        ends = [] if end is None else [end]
        lost = len(parts) == 1 and simulation.loses(guided, _NEAR_MOTION)
        # Another start's end has a space of its own, in whose scales its unknowns are.
        lost = lost and all(self._simulation(one).loses(one.solved.unknowns, _NEAR_MOTION) for one in ends)
        if led and lost and (short := self._begun_short(simulation, guided, best)) is not None:
            if np.all(short.deviation < _NEAR_NOISE * noise):
                return short
            ends.append(short)
        try:
            ends.append(self._ended(simulation, guided, best))
        except FloatingPointError:
            # Where a filter predicts, no simulation need stay.
            if not ends:
                ends.append(self._ended(simulation, unknowns, best))
        return min(ends, key=lambda one: one.cost)

    @property
    def noise(self) -> Float[np.ndarray, " output"]:
        """Return the noise of each channel, SI units; 1 where none is known."""
        return in_channels(self.levels)

    def _simulation(self, end: DescentEnd) -> FreeSimulation:
        return FreeSimulation(end.model, self.data, end.space, self.noise, end.substeps)

    def _guided(self, simulation: FreeSimulation, unknowns: Unknowns, parts: Sequence[Data]) -> Unknowns | None:
        """Return where predictions with ever weaker correction, and simulations of ever longer parts, lead; None if nowhere."""
        model, space, substeps = simulation.model, simulation.space, simulation.substeps
        scales = scales_of(model, self.experiments)
        for fraction in _CORRECTION:
            gain, corrected = correction(parts[0], model, space, unknowns, simulation.noise, scales, fraction, substeps)
            arguments = Arguments(model, parts[0], space, corrected, gain, substeps)
            self._require_determined(simulation, unknowns)
            try:
                near = self._solve(unknowns, arguments, tolerance=1e-3, gain=_GUIDANCE, most=min(_STAGE, self.steps))
            except FloatingPointError:
                # Gains that do not know an effect's own states may make these grow where no simulation does.
                continue
            unknowns = near.unknowns
            if fraction == _CORRECTION[0]:
                # Half a unit of each sample is noise: whoever predicts that well is not hopeless.
                if near.cost > _HOPELESS * max(self.nearest, 0.5 * float(jnp.sum(self.data.present))):
                    return None
                self.nearest = min(self.nearest, near.cost)
        return self._led(simulation, unknowns, parts[:-1])

    def _led(self, simulation: FreeSimulation, unknowns: Unknowns, parts: Sequence[Data]) -> Unknowns:
        """Return where simulations of ever longer parts of the data lead."""
        for part in parts:
            arguments = dataclasses.replace(simulation.arguments(), data=part)
            unknowns = self._solve(
                unknowns, arguments, tolerance=1e-2, gain=_GUIDANCE, most=min(_STAGE, self.steps)
            ).unknowns
        return unknowns

    def _begun_short(self, simulation: FreeSimulation, unknowns: Unknowns, best: float) -> DescentEnd | None:
        """Descend from where short parts of the data lead that a simulation follows; None where that leads nowhere."""
        parts = [self.data.beginning(self.data.samples // part) for part in _PARTS]
        with contextlib.suppress(FloatingPointError):
            return self._ended(simulation, self._led(simulation, unknowns, parts), best)
        return None

    def _ended(
        self, simulation: FreeSimulation, unknowns: Unknowns, best: float, *, most: int | None = None
    ) -> DescentEnd:
        """Descend by the free simulation, in so many steps at most, with the arm begun elsewhere where that leaves less."""
        begun = simulation.error(unknowns)
        if (same := self._followed(begun, simulation.noise)) is not None:
            return same
        end = self._weighted(simulation, unknowns, simulation.rms(begun), best, most=most)
        if (elsewhere := self._turned(end)) is not None:
            turned = self._weighted(simulation, elsewhere, end.deviation, best)
            end = min(end, turned, key=lambda one: one.cost)
        if most is None or end.solved.converged:  # one that was cut short is no end
            self.followed.append((begun, end))
        return end

    def _weighted(
        self, simulation: FreeSimulation, unknowns: Unknowns, deviation: Float[np.ndarray, " output"], best: float, *,
        most: int | None = None,
    ) -> DescentEnd:  # fmt: skip
        """Descend with channels weighted by what is left of them: first at the beginning, then at every point.

        Weighted anew from far off, a channel that is easily followed would soon be all that counts.
        """
        space, noise = simulation.space, ConcentratedNoise.of(self.data)
        self._require_determined(simulation, unknowns)
        weighted = simulation.arguments(deviation)
        solved = self._solve(unknowns, weighted, tolerance=1e-2, gain=_START, most=min(_STAGE, self.steps))
        constant = float(noise.counts @ np.log(simulation.noise))
        cost = noise.cost(solved.squares) + float(noise.counts @ np.log(deviation))
        # One that is hopeless beside another start is not worth the last digits.
        enough = self.steps if most is None else min(most, self.steps)
        most = enough if cost <= best + float(np.sum(noise.counts)) else 1
        # In units of the sensors' noise, as whoever weighs anew begins from no weights.
        solved = self._solve(solved.unknowns, simulation.arguments(), tolerance=self.tolerance, most=most, noise=noise)
        cost = constant + noise.cost(solved.squares) + space.penalty(space.physical(solved.unknowns)[0])
        left = noise.deviations(solved.squares) * simulation.noise
        return DescentEnd(simulation.model, space, solved, left, cost, simulation.substeps)

    def _turned(self, end: DescentEnd) -> Unknowns | None:
        """Return the unknowns with the arm begun elsewhere, in experiments that do not tell its angle, where that leaves less.

        None where it does not, and where the simulation leaves no more than noise.
        """
        if not angle_unknown(end.space).any():
            return None
        shared, each, start = end.space.physical(end.solved.unknowns)
        # The starts alone, at these parameters, as a comparison seeks them; by the program of the fit.
        space = dataclasses.replace(
            end.space,
            values=shared,
            each_values=each,
            start=start,
            active=jnp.full_like(end.space.active, len(end.space.names)),
        )
        arguments = dataclasses.replace(self._simulation(end), space=space).arguments()
        unknowns = space.unconstrained()
        if not np.any(beyond_noise(unknowns, arguments) & angle_unknown(space)):
            return None
        found = searched(unknowns, arguments)
        if found is None or np.all(squares(found, arguments) > _TURNED * squares(unknowns, arguments)):
            return None
        states = space.physical(found)[2]
        scaled = (states - end.space.start) / end.space.start_scale
        return end.solved.unknowns._replace(start=jnp.where(end.space.start_held > 0, 0.0, scaled))

    def _followed(self, guided: np.ndarray, noise: np.ndarray) -> DescentEnd | None:
        """Return the end of an earlier descent that went through the same simulation; None if none did."""
        count = np.maximum(np.asarray(self.data.present).sum(axis=(0, 2)), 1.0)
        for earlier, end in self.followed:
            apart = np.sqrt(((guided - earlier) ** 2).sum(axis=(0, 2)) / count)
            if np.all(apart <= _ALIKE * np.maximum(noise, end.deviation)):
                return end
        return None

    def _solve(
        self, unknowns: Unknowns, arguments: Arguments, *, tolerance: float, gain: float = NEGLIGIBLE, most: int,
        noise: ConcentratedNoise | None = None,
    ) -> Solved:  # fmt: skip
        return solve_bounded(
            unknowns, arguments, tolerance=tolerance, gain=gain, most=most, progress=self._show, noise=noise, far=FAR
        )

    def weighted(self, stage: DescentEnd, data: Data, experiments: Sequence[Experiment]) -> Robust:
        """Go on from the end of a descent with weights that discount what lies too far off for noise, in all of the data."""
        return robust_fit(
            stage.model,
            data,
            stage.space,
            stage.solved.unknowns,
            experiments,
            substeps=stage.substeps,
            noise=self.noise,
            tolerance=1e-4,
            steps=self.steps,
            progress=self._show,
        )

    def _show(self, text: str) -> None:
        self.taken += 1
        self.progress.step(text)

    def _require_determined(self, simulation: FreeSimulation, unknowns: Unknowns) -> None:
        """Refuse data that leave parameters free, before the first step.

        Along directions that are free the descent would wander until the model breaks. What a free simulation of all the data tells
        beside the noise of the sensors is asked: what the start misses, or a filter that follows sensors hides, a descent finds.
        """
        if self.taken == 0:
            first = np.asarray(factor(unknowns, simulation.arguments()))
            if not diverged(first) and np.max(np.abs(first)) < _SQUARED:
                information(first, simulation.space, unknowns).require_determined()
