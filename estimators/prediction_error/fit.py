"""Prediction error of the nonlinear model: physics and random forces from one-step-ahead predictions of a Kalman filter."""

import dataclasses
import time
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from estimators.closed_form.fit import starting_values
from estimators.closed_form.initial_angle import with_initial_angles
from estimators.core.active_bounds import OFF_BOUNDS
from estimators.core.correlation import LAGS, LEVEL, whiteness
from estimators.core.data import CHANNELS, Data, moving, pieces
from estimators.core.drawing import draw
from estimators.core.fisher_information import Information, information, told_deviations
from estimators.core.fit import HEADER, ModelFit
from estimators.core.information_criteria import InformationCriteria
from estimators.core.initial_state import scales_of, space_of
from estimators.core.jacobian_factor import Arguments, diverged, factor
from estimators.core.linearisation import Problem
from estimators.core.parameter_space import Space, number_of_unknowns
from estimators.core.progress import Progress
from estimators.core.results import DivergedError
from estimators.core.sensor_noise import noise_levels
from estimators.core.threads import one_blas_thread
from estimators.prediction_error.fisher_scoring import most_likely
from estimators.prediction_error.initial_angle import with_likeliest_angles
from estimators.prediction_error.innovations import one_step_rms
from estimators.prediction_error.noise_estimation import Predictor, fit_trusted
from estimators.prediction_error.noise_model import NoiseModel
from estimators.prediction_error.predictive_steps import predictive_substeps
from rtac_jax import RTAC, require_configured
from rtac_jax.arguments import checked_arguments
from rtac_jax.effect_contract import require_working_model
from rtac_jax.excited_parts import excited_parts
from rtac_jax.measurement import Experiment, Recording
from rtac_jax.overview import Overview
from rtac_jax.simulation import Steps


@dataclasses.dataclass(frozen=True)
class Whiteness:
    """The whiteness of the innovations of a channel in one experiment.

    Attributes:
        experiment, channel: names of both.
        rms: of the innovations over their expected size; 1 where the predictor's noise is right.
        autocorrelation: at lags 1, 2, ... samples [1].
        band: 99 % of each lie within plus and minus this by chance.
        p_value: of all lags together (Ljung and Box).
    """

    experiment: str
    channel: str
    rms: float
    autocorrelation: Float[np.ndarray, " lag"]
    band: float
    p_value: float


@dataclasses.dataclass(frozen=True, repr=False)
class PredictorFit(ModelFit):
    """The result of `prediction_error_nonlinear`.

    Attributes:
        model: with the estimated values; parameters of each experiment as arrays in the order of `experiments`.
        information: covariance and identifiability of the free shared parameters.
        each_std: standard deviations of the parameters of each experiment, the others integrated out.
        force_noise: square root of the two-sided spectral density of the random force on the cart [N/sqrt(Hz)].
        torque_noise: the same of the random torque on the arm [N m/sqrt(Hz)].
        noise: standard deviation of each channel's sensor.
        whiteness: of the innovations, by experiment and channel.
        log_likelihood: of all data, less a constant.
        experiments: names of the experiments.
        statistics: substeps, samples, their fraction of those that were measured, seconds, number of unknowns, and rms of the
            prediction errors by channel.
        problem: that was solved, at its solution.
        prior: of the noise.
        noise_exponents: the estimated noise as `run_filter` takes it.
    """

    model: RTAC
    information: Information
    each_std: Mapping[str, Float[np.ndarray, " experiment"]]
    force_noise: float
    torque_noise: float
    noise: Mapping[str, float]
    whiteness: tuple[Whiteness, ...]
    log_likelihood: float
    experiments: tuple[str, ...]
    statistics: Mapping[str, Any]
    problem: Problem = dataclasses.field(repr=False)
    prior: NoiseModel = dataclasses.field(repr=False)
    noise_exponents: Float[np.ndarray, " noise"] = dataclasses.field(repr=False)

    @property
    def criteria(self) -> InformationCriteria:
        """AIC, BIC and FPE, of predictions one sample ahead."""
        count = self.statistics["samples"]
        value = self.log_likelihood - 0.5 * count * float(np.log(2 * np.pi))
        return InformationCriteria(value, self.statistics["unknowns"], int(count), self.statistics["one_step_rms"])

    @property
    def verdict(self) -> str:
        """Return the verdict of the whiteness tests on the model."""
        bound = LEVEL / len(self.whiteness)
        coloured = sorted((w for w in self.whiteness if w.p_value < bound), key=lambda w: w.p_value)
        if not coloured:
            return "The innovations are white: a random force and torque explain what the physics leaves."
        worst = coloured[0]
        return (
            f"The innovations are coloured in {len(coloured)} of {len(self.whiteness)} channels, most in {worst.channel} of "
            f"{worst.experiment}: more than random forces is missing; ask est.diagnose."
        )

    def overview(self) -> Overview:
        """Return parameters with standard deviations, and what the innovations say of the model."""
        title = f"{len(self.information.names)} parameters from predictions of {len(self.experiments)} experiments"
        return Overview(title, HEADER, self.rows(), (self.verdict, *self.information.weak_sentences()))

    def __str__(self) -> str:
        lines = self.lines()
        lines.append(f"{'random force on the cart':30s} {self.force_noise:12.3g} {'':10s}  N/sqrt(Hz)")
        lines.append(f"{'random torque on the arm':30s} {self.torque_noise:12.3g} {'':10s}  N m/sqrt(Hz)")
        for channel, level in self.noise.items():
            lines.append(f"{'sensor noise of ' + channel:30s} {level:12.3g}")
        return "\n".join([*lines, str(self.criteria), self.verdict, *self.information.weak_sentences()])

    def plot(self) -> Any:
        """Draw the autocorrelation of the innovations with its band."""
        return draw(self)


@checked_arguments
@one_blas_thread()
def prediction_error_nonlinear(
    model: RTAC,
    recording: Recording,
    *,
    rounds: int = 10,
    from_model: bool = False,
    progress: bool = True,
) -> PredictorFit:
    """Fit a model to all moving experiments of a recording by its predictions one sample ahead.

    An extended Kalman filter mends the state at each sample by what was measured, as far as a random force on the cart and a
    random torque on the arm, both white, make it doubtful. Their sizes and the sensors' noise are estimated by maximum
    likelihood, in turn with the physics. Unlike the simulation of `output_error`, predictions forget a disturbance, so
    that the physics is not bent to explain it, and standard deviations count it.

    The states at the start are taken from the first samples, as doubtful as those are; the filter mends them. What was
    measured of constants beforehand (`RTAC.priors`) is counted as by `output_error`.

    The filter is linear along its estimate, and dry friction is not: samples at which random forces may shake loose what
    dry friction holds do not count.

    Args:
        model: those of its free parameters named with `RTAC.each_experiment` are estimated for each experiment, the others for all.
        recording: with moving experiments; those at rest tell the sensors' noise.
        rounds: at most, of physics and noise in turn.
        from_model: begin at the model's values instead of the closed form.
        progress: show how far it is, as `core.progress.Progress` does.

    Raises:
        ValueError: nothing moves in the recording, no parameter is free, or a user's own effect does not work.
        NotIdentifiableError: the data leave parameters free.
        DivergedError: the model diverges at the start.
        RuntimeError: JAX was not configured for double precision.

    Source: Kristensen, Madsen and Jorgensen, Automatica 40 (2004); Ljung, System Identification (1999), section 7.
    """
    require_configured()
    began = time.perf_counter()
    experiments = pieces(moving(recording))
    require_working_model(model, batch=False)
    if not model.free:
        raise ValueError("The model has no free parameter; release one with model.release(name).")
    levels = noise_levels(recording.experiments)
    data = Data.of(experiments)
    start = model if from_model else starting_values(model, recording)
    shared = [name for name in start.free if name not in start.per_experiment]
    # Angles that nobody measured are found from how the arm pushes the cart, as far as that shows them.
    begun = with_initial_angles(start, experiments, levels)
    space = space_of(start, begun, free=shared)
    scales = scales_of(start, experiments)
    prior = NoiseModel.of(levels, recording.experiments, scales, space)
    begin = space.physical(space.unconstrained(off_bounds=OFF_BOUNDS))
    substeps = predictive_substeps(start, data, space, begin, prior)
    with Progress("prediction error", show=progress) as shown:
        steps = jnp.asarray(substeps)
        try:
            space = with_likeliest_angles(start, data, space, prior, steps)
            found, data = fit_trusted(
                start, data, space, prior, substeps=steps, rounds=rounds, off_bounds=OFF_BOUNDS, progress=shown.step
            )
            factors = factor(found.unknowns, _arguments_at(found, start, data, space, substeps))
            if diverged(factors):
                raise DivergedError(
                    "The model diverges at the estimate; begin with from_model=True at values nearer to the rig."
                )
            frozen = np.asarray(factors)
            information(frozen, space, found.unknowns).require_determined()
            found, triangles = most_likely(
                found, start, data, space, prior, frozen, substeps=steps, progress=shown.step
            )
        except FloatingPointError as error:
            raise DivergedError(str(error)) from None
        except np.linalg.LinAlgError:
            raise DivergedError(
                "Predictions one sample ahead leave some parameter without any effect: the model follows next to nothing of the"
                " recording, or its parameters cannot be told apart."
            ) from None
    arguments = _arguments_at(found, start, data, space, substeps)
    known = information(triangles, space, found.unknowns)
    known.require_determined()
    shared_values, each, _ = (np.asarray(part) for part in found.physical)
    values = dict(zip(space.names, shared_values, strict=True)) | dict(zip(space.each, each, strict=True))
    interval = float(np.min(np.asarray(data.excitation.sample_time)))
    force, torque = np.exp(0.5 * found.noise[:2]) * np.array([scales.force, scales.torque]) * np.sqrt(interval)
    sensor = np.exp(0.5 * found.noise[2:]) * prior.sensor
    return PredictorFit(
        model=start.with_values(values),
        information=known,
        each_std=told_deviations(triangles, space, found.unknowns),
        force_noise=float(force),
        torque_noise=float(torque),
        noise={c: float(s) for c, s in zip(CHANNELS, sensor, strict=True) if c in levels},
        whiteness=_whiteness(found, data, experiments),
        log_likelihood=found.log_likelihood,
        experiments=tuple(e.name for e in experiments),
        statistics={
            "substeps": substeps,
            "samples": float(jnp.sum(data.counted)),
            "counted": float(jnp.sum(data.counted) / jnp.sum(data.present)),
            "unknowns": number_of_unknowns(space, found.unknowns) + 2 + len(levels),  # and force, torque, sensors
            "one_step_rms": one_step_rms(found.filtered),
            "seconds": time.perf_counter() - began,
            "unexcited": tuple(sorted(excited_parts(recording)[1])),
        },
        problem=Problem(arguments, found.unknowns, tuple(experiments), known.names),
        prior=prior,
        noise_exponents=found.noise,
    )


def _arguments_at(found: Predictor, model: RTAC, data: Data, space: Space, substeps: Steps) -> Arguments:
    return Arguments(model, data, space, found.filtered.whitener, found.filtered.gain, substeps)


def _whiteness(found: Predictor, data: Data, experiments: list[Experiment]) -> tuple[Whiteness, ...]:
    innovations = np.asarray(found.filtered.innovations)
    counts = np.asarray(data.counted)
    result = []
    for column, experiment in enumerate(experiments):
        for row, channel in enumerate(CHANNELS):
            count = float(np.sum(counts[:, row, column]))
            if count < 2 * LAGS:
                continue
            error = innovations[: experiment.samples, row, column]
            own = whiteness(error, counts[: experiment.samples, row, column])
            rms = float(np.sqrt(np.sum(error**2) / count))
            result.append(Whiteness(experiment.name, channel, rms, own.autocorrelation, own.band, own.p_value))
    return tuple(result)
