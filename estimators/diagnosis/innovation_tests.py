"""Tests of the innovations of a fitted predictor: which candidates they speak for, and whether anything is left."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import jax.numpy as jnp
import numpy as np

from estimators.core.compilation import Ahead
from estimators.core.data import CHANNELS, motion_of
from estimators.core.fit import Fit
from estimators.core.initial_state import scales_of
from estimators.core.residual import start_rows
from estimators.core.sensor_noise import noise_levels, only_rounding
from estimators.core.threads import at_once
from estimators.diagnosis.candidate_groups import candidate_groups, model_alone, model_beside
from estimators.diagnosis.evidence import SimulationError
from estimators.diagnosis.refit import Refit, Tested
from estimators.diagnosis.setting import Setting, begun, by_name, padded_space, shared, space_for
from estimators.diagnosis.shared_structure import passed_as
from estimators.inference.shaken_simulation import simulation_deviation
from estimators.inference.simulation_residual import of_unknown_noise
from estimators.misspecification.candidate_screening import Group, NotNothingError, Screened, same, screen
from estimators.misspecification.detection_limit import detection_limits
from estimators.misspecification.drift_test import parameter_drifts
from estimators.misspecification.findings import Findings, LaggedForce, Score, StaticForce
from estimators.misspecification.lagged_force import delayed_forces
from estimators.misspecification.line_classes import LineClass, line_classes
from estimators.misspecification.replication_test import repeat_test
from estimators.misspecification.residual_maps import Place, where
from estimators.misspecification.spectral_line_test import spectral_line
from estimators.misspecification.static_force import SLOW, force_curves
from estimators.prediction_error.filter_pass import run_filter
from estimators.prediction_error.innovations import Innovations, Rows, orthonormal
from estimators.prediction_error.latent_force import LatentForce, latent_forces
from estimators.prediction_error.noise_estimation import low_process_noise
from estimators.prediction_error.noise_model import start_variance
from rtac_jax import RTAC
from rtac_jax.programs.arrays import to_jax


def pieces_of_tests(
    setting: Setting, added: Sequence[str] = (), free: Sequence[str] | None = None
) -> list[Callable[[], None]]:
    """Return what compiles the code of `tested`, in the order in which that runs it, for another thread.

    Args:
        setting: of the diagnosis.
        added: effects that the model has beside those of the base model.
        free: its free parameters, by default those of the base model.
    """
    free = shared(setting.model) if free is None else free
    alone = partial(_unfitted, setting, model_alone(setting, added), free)
    groups = [partial(_unfitted, setting, group.model, free) for group in candidate_groups(setting, added)]
    return [
        lambda: alone().compile_derivatives(),
        *(partial(_compile, group) for group in groups),
    ]


def _unfitted(setting: Setting, model: RTAC, free: Sequence[str]) -> Innovations:
    """Return innovations for compiling only: the shapes are right, gains and whiteners are nothing."""
    gain, whitener = (
        to_jax(np.zeros((setting.data.room, count, len(CHANNELS), setting.data.experiments)))
        for count in (len(model.states), len(CHANNELS))
    )
    return Innovations(model, setting.data, padded_space(setting, model, free), whitener, gain, setting.substeps)


def run_tests(setting: Setting, refit: Refit, ahead: Ahead | None = None) -> Tested:
    """Run all tests of the innovations of a model; `ahead` compiles `pieces_of_tests`."""
    ready = _nothing if ahead is None else ahead.next
    probed = _innovations(setting, refit, model_alone(setting, refit.added), refit.free)
    ready()
    jacobian = probed.jacobian()
    basis = orthonormal(jacobian)
    error = _error(setting, refit, probed, basis)
    screened = _screened(setting, refit, probed, error, basis, ready)
    scales = scales_of(setting.model, setting.experiments)
    slow = (SLOW * scales.velocity, SLOW * scales.arm_velocity)
    curves = force_curves(probed, error, basis, _ranges(setting), slow)
    stiffness = float(np.asarray(setting.model.body.spring_stiffness))
    delayed = delayed_forces(
        probed, error, basis, setting.experiments, frequency=scales.frequency, stiffness=stiffness
    )  # fmt: skip
    whitened, present = _counted(setting, refit)
    alone = only_rounding(setting.experiments, noise_levels(setting.recording.experiments))
    line = spectral_line(whitened, present, setting.experiments, alone)
    repeats = repeat_test(whitened, present, setting.experiments)
    findings = Findings(
        scores_of(screened),
        tuple(StaticForce(c.port, c.variable, float(c.p_value), float(c.excess)) for c in curves),
        tuple(LaggedForce(one.port, one.follows, float(one.p_value), float(one.excess)) for one in delayed),
        line,
        repeats,
        tuple(parameter_drifts(probed, jacobian, error)),
    )
    return Tested(tuple(screened), tuple(curves), findings)


def screened_at_low_noise(setting: Setting, refit: Refit) -> list[Screened]:
    """Score candidates against a predictor with low process noise.

    Random forces that stand for a missing effect make the predictor follow the sensors, and hide from it what moves
    slowly beside the samples. Such statistics only rank: the innovations are not white.
    """
    found = refit.predictor
    noise = low_process_noise(found.noise)
    prior = setting.prior.starting(refit.space)
    model, space, physical = passed_as(setting, refit.added, refit.model, refit.space, found.physical)
    passed = run_filter(model, setting.data, space, physical, prior, noise, setting.substeps)
    quiet = dataclasses.replace(refit, predictor=dataclasses.replace(found, noise=noise, filtered=passed))
    probed = _innovations(setting, quiet, model_alone(setting, quiet.added), quiet.free)
    basis = orthonormal(probed.jacobian())
    return _screened(setting, quiet, probed, _error(setting, quiet, probed, basis), basis)


def simulation_error(setting: Setting, fit: Fit, base: Refit) -> SimulationError:
    """Return the simulation error of a fit beside what the random forces of a predictor would leave of it.

    Args:
        setting: of the diagnosis.
        fit: whose simulation it is.
        base: the predictor of the same model.
    """
    start = np.stack([fit.start[e.name] for e in setting.experiments], axis=1)
    space = begun(
        space_for(setting, base.model, base.free), base.model, dict(zip(start_rows(fit.model), start, strict=True))
    )
    values = base.values | {name: float(np.asarray(fit.model[name])) for name in shared(fit.model)}
    physical = (
        jnp.asarray([values[name] for name in space.names]), base.predictor.physical[1], space.start,
    )  # fmt: skip
    prior, noise = setting.prior.starting(space), base.predictor.noise
    model, space, physical = passed_as(setting, base.added, base.model, space, physical)
    deviation = simulation_deviation(model, setting.data, space, physical, prior, noise, setting.substeps)
    signal = motion_of(setting.data)
    rows = {c: CHANNELS.index(c) for c in fit.residual_std}
    return SimulationError(
        {c: float(fit.residual_std[c] / fit.noise[c]) for c in rows},
        {c: float(deviation[row]) / fit.noise[c] for c, row in rows.items() if np.isfinite(deviation[row])},
        {c: float(signal[row]) / fit.noise[c] for c, row in rows.items()},
        (float(base.predictor.random_force), float(base.predictor.random_torque)),
        of_unknown_noise(fit.residual_std, setting.recording),
    )


def places_of(setting: Setting, refit: Refit) -> tuple[Place, ...]:
    """Return the parts of the data by the size of their innovations, the largest excess first."""
    whitened, present = _counted(setting, refit)
    return tuple(where(whitened, present, setting.experiments))


def lines_of(setting: Setting, refit: Refit) -> tuple[LineClass, ...]:
    """Return the innovations by class of spectral line."""
    whitened, present = _counted(setting, refit)
    return tuple(line_classes(whitened, present, setting.experiments))


def latent_of(setting: Setting, refit: Refit) -> tuple[LatentForce, ...]:
    """Return the missing force in time."""
    probed = _innovations(setting, refit, model_alone(setting, refit.added), [])
    scales = scales_of(setting.model, setting.experiments)
    physical = (probed.space.values, refit.predictor.physical[1], probed.space.start)
    return latent_forces(
        probed.model, setting.data, probed.space, physical, probed.gain,
        setting.substeps, setting.experiments,
        sensor_variance=np.exp(refit.predictor.noise[2:]) * setting.prior.sensor**2,
        start_variance=start_variance(probed.space),
        force=scales.force, torque=scales.torque, frequency=scales.frequency,
    )  # fmt: skip


def _screened(
    setting: Setting,
    refit: Refit,
    probed: Innovations,
    error: np.ndarray,
    basis: Rows,
    ready: Callable[[], None] | None = None,
) -> list[Screened]:
    """Score candidates that were not added to a fitted model, against its innovations.

    Raises:
        ValueError: a candidate that is not nothing where its parameters are at null.
    """
    raw = _raw(setting, refit, probed)
    try:
        return screen(_groups(setting, refit, raw), error, basis, ready or _nothing, setting.policy.critical)
    except NotNothingError as found:
        for i in found.ids:
            alone = _innovations(setting, refit, model_beside(setting, refit.added, i), refit.free)
            if not same(alone.at(np.asarray(alone.space.values)[None])[:, 0], raw):
                raise ValueError(
                    f"candidates: {i} changes what the model predicts although its parameters are at null, or makes it "
                    "NaN; correct null, or make what it adds finite and zero there."
                ) from None
        raise ValueError(f"candidates: together {', '.join(found.ids)} make the model diverge at null.") from None


def _groups(setting: Setting, refit: Refit, raw: np.ndarray) -> list[Group]:
    return [
        Group(
            _innovations(setting, refit, group.model, refit.free),
            [i for i in setting.instances if i.id in group.ids],
            raw,
        )
        for group in candidate_groups(setting, refit.added)
    ]


def limits_of(setting: Setting, refit: Refit, best: Mapping[str, Screened]) -> dict[str, float]:
    """Return the size from which on each candidate would be found beside a fitted model."""
    probed = _innovations(setting, refit, model_alone(setting, refit.added), refit.free)
    basis = orthonormal(probed.jacobian())

    def of(group: Group) -> dict[str, float]:
        ids = {instance.id for instance in group.instances}
        return detection_limits(group, [s for s in best.values() if s.id in ids], basis, setting.policy.testable)

    parts = at_once(of, _groups(setting, refit, _raw(setting, refit, probed)))
    return {i: limit for part in parts for i, limit in part.items()}


def _raw(setting: Setting, refit: Refit, probed: Innovations) -> np.ndarray:
    return probed.rows(_counted(setting, refit)[0][None])[:, 0]


def _error(setting: Setting, refit: Refit, probed: Innovations, basis: Rows) -> np.ndarray:
    """Return the innovations of a fitted model, without their part in the basis."""
    raw = _raw(setting, refit, probed)
    return raw - basis @ (basis.T @ raw)


def _innovations(setting: Setting, refit: Refit, model: RTAC, free: Sequence[str]) -> Innovations:
    """Return the innovations of a fitted model, as those of a model with candidates at null beside it."""
    space = padded_space(setting, model, free)
    predictor = refit.predictor
    space = begun(space, model, refit.start)
    values = by_name(space, refit.space, predictor.physical[0])
    space = dataclasses.replace(space, values=values, each_values=predictor.physical[1])
    # A state that the filter does not know is not corrected.
    gain = np.asarray(predictor.filtered.gain)
    rows = {name: gain[:, i] for i, name in enumerate(refit.model.states)}
    nothing = np.zeros_like(gain[:, 0])
    placed = to_jax(np.stack([rows.get(name, nothing) for name in model.states], axis=1))
    sure = 1.0 - predictor.filtered.shaken[:, None, None]
    return Innovations(model, setting.data, space, predictor.filtered.whitener * sure, placed, setting.substeps)


def _counted(setting: Setting, refit: Refit) -> tuple[np.ndarray, np.ndarray]:
    """Return the innovations, and 1 where there are any, but for stick-slip ambiguous samples.

    There the model's own rest is in doubt, and what it predicts says nothing of what it lacks.
    """
    filtered = refit.predictor.filtered
    sure = ((1.0 - np.asarray(filtered.shaken)) * np.asarray(setting.data.trusted))[:, None]
    return np.asarray(filtered.innovations) * sure, np.asarray(setting.data.present) * sure


def _ranges(setting: Setting) -> dict[str, tuple[float, float]]:
    """Return the values between which each variable moves."""

    def between(values: list[np.ndarray]) -> tuple[float, float]:
        if not values:
            return 0.0, 0.0
        low, high = np.nanquantile(np.concatenate(values), [0.001, 0.999])
        return float(low), float(high)

    def outputs(channel: str) -> list[np.ndarray]:
        return [e.outputs[channel].values for e in setting.experiments if channel in e.outputs]

    scales = scales_of(setting.model, setting.experiments)
    # Of a swing the largest speed is the largest deflection times the frequency: a decay is several times as fast as the rms.
    deflections = [np.abs(values - np.nanmedian(values)) for values in outputs("cart_position")]
    reach = scales.frequency * between(deflections)[1]
    arm = any(e.arm == "free" for e in setting.experiments)
    return {
        "cart_position": between(outputs("cart_position")),
        "cart_velocity": (-reach, reach),
        "arm_angle": (-np.pi, np.pi) if arm else (0.0, 0.0),
        "arm_velocity": between(outputs("arm_velocity")) if arm else (0.0, 0.0),
        "current": between([e.inputs["current"].values for e in setting.experiments if "current" in e.inputs]),
    }


def _compile(innovations: Callable[[], Innovations]) -> None:
    innovations().compile()


def scores_of(screened: Sequence[Screened]) -> tuple[Score, ...]:
    """Return the scores of candidates without what they were computed from."""
    return tuple(
        Score(s.id, shape, s.amplitudes, float(s.statistic), float(s.p_value), tuple(np.asarray(s.begin).tolist()))
        for shape, s in enumerate(screened)
    )


def _nothing() -> None:
    """Do nothing: where no code is compiled ahead, there is nothing to wait for."""
