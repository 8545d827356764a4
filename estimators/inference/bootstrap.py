"""Bootstrap replicates of a recording around a fit: its own residual in another order, or random forces anew."""

import dataclasses
from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from estimators.core.data import CHANNELS, Data, in_channels, moving, origins, pieces
from estimators.core.fit import Fit
from estimators.core.initial_state import space_of
from estimators.core.jacobian_factor import Arguments, plain_residual
from estimators.core.levenberg_marquardt import solve
from estimators.core.linearisation import Problem, at_fit
from estimators.core.parameter_space import Unknowns
from estimators.core.residual import diagonal_whitener, no_gain, predict
from estimators.core.sensor_noise import noise_levels
from estimators.core.step_size import accurate_substeps
from estimators.prediction_error.fit import PredictorFit
from estimators.prediction_error.smoothed_initial_state import smoothed_start
from rtac_jax import RTAC
from rtac_jax.measurement import Experiment, Recording
from rtac_jax.programs import program

Outputs = Float[np.ndarray, "sample output experiment"]
_EXCESS = 1.5


class _Source:
    """The model and data around which replicates are drawn."""

    problem: Problem

    @property
    def experiments(self) -> tuple[Experiment, ...]:
        """Return the experiments of the fit."""
        return self.problem.experiments

    @property
    def measured(self) -> Outputs:
        """Return the recorded measurements."""
        data = self.problem.arguments.data
        return np.where(np.asarray(data.present) > 0, np.asarray(data.values), np.nan)


@dataclasses.dataclass(frozen=True)
class Shuffled(_Source):
    """The simulated measurements of a fit, and its residual to be put in another order.

    Attributes:
        problem: of the fit.
        simulated: by the fit, SI units.
        error: measured less simulated; NaN where nothing was measured.
        block: samples that stay together, per experiment.
    """

    problem: Problem
    simulated: Outputs
    error: Outputs
    block: tuple[int, ...]

    @classmethod
    def of(cls, fit: Fit, recording: Recording, *, block: float) -> "Shuffled":
        """Build replicates around a fit and the recording that it was made from, in blocks of this many seconds.

        Where the sensors' noise was recorded at rest or stated and the residual is clearly above it, the residual is made
        as large as the noise: were the model right, there would be no more.
        """
        return cls._about(at_fit(fit, recording), fit.residual_std, fit.noise, recording, block)

    @classmethod
    def of_model(cls, model: RTAC, recording: Recording, *, block: float) -> "Shuffled":
        """Build replicates around the simulation of a model at its own values, as a closed form gives it.

        Only the states at the start of each experiment are fitted.

        Raises:
            FloatingPointError: the model diverges.
        """
        levels = noise_levels(recording.experiments)
        experiments = pieces(moving(recording))
        data, space = Data.of(experiments), space_of(model, experiments, free=[])
        noise = in_channels(levels)
        unknowns = space.unconstrained()
        substeps = accurate_substeps(model, data, space, unknowns, noise)
        arguments = Arguments(model, data, space, diagonal_whitener(noise, data), no_gain(model, data), substeps)
        at = solve(unknowns, arguments, tolerance=1e-4, most=20).unknowns
        problem = Problem(arguments, at, tuple(experiments), ())
        left = np.asarray(plain_residual(at, arguments)[0])
        count = np.maximum(np.asarray(data.present).sum(axis=(0, 2)), 1.0)
        rms = noise * np.sqrt((left**2).sum(axis=(0, 2)) / count)
        return cls._about(problem, dict(zip(CHANNELS, rms, strict=True)), levels, recording, block)

    @classmethod
    def _about(
        cls, problem: Problem, rms: Mapping[str, float], noise: Mapping[str, float], recording: Recording, block: float
    ) -> "Shuffled":
        arguments = dataclasses.replace(
            problem.arguments, whitener=diagonal_whitener(np.ones(len(CHANNELS)), problem.arguments.data)
        )
        error = np.array(plain_residual(problem.unknowns, arguments)[0])
        present = np.asarray(problem.arguments.data.present) > 0
        measured = np.asarray(problem.arguments.data.values)
        lengths = tuple(max(1, round(block / e.sample_time)) for e in problem.experiments)
        simulated = measured - error
        known = any(e.kind == "rest" for e in recording.experiments)
        for row, channel in enumerate(CHANNELS):
            stated = any(e.outputs[channel].noise_std is not None for e in problem.experiments if channel in e.outputs)
            if channel in noise and (known or stated):
                excess = rms[channel] / noise[channel]
                error[:, row] /= excess if excess > _EXCESS else 1.0
        return cls(problem, simulated, np.where(present, error, np.nan), lengths)

    def draw(self, random: np.random.Generator) -> Outputs:
        """Draw blocks of the residual, all channels together, in random order on a circle.

        Source: Politis and Romano, in Exploring the Limits of Bootstrap (1992): circular blocks.
        """
        drawn = np.full(self.error.shape, np.nan)
        for i, (e, length) in enumerate(zip(self.problem.experiments, self.block, strict=True)):
            starts = random.integers(0, e.samples, -(-e.samples // length))
            index = (starts[:, None] + np.arange(length)).ravel()[: e.samples] % e.samples
            shuffled = self.error[index, :, i]
            # A gap stays where it was; a gap that moved in is filled with nothing.
            present = np.isfinite(self.error[: e.samples, :, i])
            drawn[: e.samples, :, i] = np.where(present, np.nan_to_num(shuffled), np.nan)
        return self.simulated + drawn


@dataclasses.dataclass(frozen=True)
class Shaken(_Source):
    """The model of a predictor, struck by random impulses of the size that it estimated, with its sensors' noise.

    Attributes:
        problem: of the predictor.
        impulse: standard deviation of the impulses on cart and arm in one sample [N s, N m s], by experiment.
        sensor: standard deviation of each channel's noise, SI units.
        start: states at the start.
    """

    problem: Problem
    impulse: Float[np.ndarray, "2 experiment"]
    sensor: Float[np.ndarray, " output"]
    start: Float[np.ndarray, "start experiment"]

    @classmethod
    def of(cls, fit: PredictorFit) -> "Shaken":
        """Build replicates at the fit's parameters and noise, and at its smoothed starts."""
        start = smoothed_start(fit)
        interval = np.asarray(fit.problem.arguments.data.excitation.sample_time)
        density = np.array([fit.force_noise, fit.torque_noise])
        sensor = np.array([fit.noise.get(channel, 0.0) for channel in CHANNELS])
        return cls(fit.problem, density[:, None] * np.sqrt(interval), sensor, start)

    def draw(self, random: np.random.Generator) -> Outputs:
        """Simulate with white impulses and white sensor noise."""
        data = self.problem.arguments.data
        struck = np.zeros((data.room, 2, *self.impulse.shape))
        struck[: data.samples] = random.normal(size=struck[: data.samples].shape) * self.impulse
        at = self.problem
        noisy = np.array(_struck(at.unknowns, at.arguments, jnp.asarray(self.start), jnp.asarray(struck)))
        noisy[: data.samples] += random.normal(size=noisy[: data.samples].shape) * self.sensor[:, None]
        return np.where(np.asarray(data.present) > 0, noisy, np.nan)


@program
def _struck(unknowns: Unknowns, arguments: Arguments, start: Array, impulses: Array) -> Array:
    a = arguments
    shared, each, _ = a.space.physical(unknowns)
    return predict(a.model, a.data, a.space, (shared, each, start), substeps=a.substeps, impulses=impulses)


Source = Shuffled | Shaken


def measured_again(experiments: Sequence[Experiment], source: Source, values: Outputs) -> list[Experiment]:
    """Return the experiments with other measurements; pieces of a long experiment are put together again."""
    columns: dict[str, list[np.ndarray]] = {}
    origin = origins(experiments)
    for i, piece in enumerate(source.experiments):
        columns.setdefault(origin.get(piece.name, piece.name), []).append(values[: piece.samples, :, i])
    tables: Mapping[str, np.ndarray] = {name: np.concatenate(parts) for name, parts in columns.items()}
    found = []
    for e in experiments:
        if e.name not in tables:
            continue
        outputs = {
            c: dataclasses.replace(s, values=tables[e.name][:, CHANNELS.index(c)])
            for c, s in e.outputs.items()
            if c in CHANNELS
        }
        found.append(dataclasses.replace(e, outputs=outputs))
    return found
