"""Predictions of a recording several samples ahead, by a fitted physical model and its Kalman predictor."""

from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from estimators.core.data import CHANNELS, Data, first_sample, in_channels
from estimators.core.initial_state import scales_of, space_of
from estimators.core.step_size import accurate_substeps
from estimators.prediction_error.ekf import filtered
from estimators.prediction_error.fit import PredictorFit
from estimators.prediction_error.noise_estimation import fit_noise
from estimators.prediction_error.noise_model import NoiseModel, start_variance
from estimators.prediction_error.several_steps_ahead import predict_ahead
from rtac_jax import RTAC
from rtac_jax.measurement import Experiment

_SETTLED = 10  # samples from which a predictor that knew nothing knows the speeds


def ahead_of(
    model: RTAC,
    experiments: Sequence[Experiment],
    levels: Mapping[str, float],
    *,
    ahead: int,
    fit: PredictorFit | None,
    starts: Mapping[str, Float[np.ndarray, " state"]],
) -> tuple[Float[np.ndarray, "sample output experiment"], dict[str, Float[np.ndarray, " state"]]]:
    """Predict experiments so many samples ahead, and return the outputs and the states at the start.

    Both are from the first sample on that shows where an experiment begins; before it there are no outputs.

    Args:
        model: with its values.
        experiments: that move.
        levels: standard deviation of each channel's noise.
        ahead: samples.
        fit: by predictions one sample ahead, whose random forces and sensor noise are taken; without one they are those that
            make these experiments likeliest.
        starts: states at the start of experiments whose first samples do not show where the arm is.
    """
    begins = [first_sample(e) for e in experiments]
    whole, room = experiments, max(e.samples for e in experiments)
    experiments = [e.cut(begin, e.samples, e.name) if begin else e for begin, e in zip(begins, whole, strict=True)]
    space, data = space_of(model, experiments, free=[], start=starts), Data.of(experiments)
    sensors = in_channels(levels)
    substeps = jnp.asarray(accurate_substeps(model, data, space, space.unconstrained(), sensors))
    physical = space.physical(space.unconstrained(start=False))
    if fit is None:
        prior = NoiseModel.of(levels, experiments, scales_of(model, experiments), space)
        gain = fit_noise(model, data, space, physical, prior, None, substeps).filtered.gain
    else:
        sensors = np.array([fit.noise.get(channel, level) for channel, level in zip(CHANNELS, sensors, strict=True)])
        variance = jnp.asarray(np.broadcast_to(sensors[:, None] ** 2, (len(CHANNELS), data.experiments)))
        gain = filtered(
            model, data, space, physical, sensor_variance=variance,
            process=(jnp.asarray(fit.force_noise**2), jnp.asarray(fit.torque_noise**2)),
            start_variance=start_variance(space), substeps=substeps,
        ).gain  # fmt: skip
    outputs = np.asarray(predict_ahead(model, data, space, physical, gain, ahead=ahead, substeps=substeps))
    found = np.full((room, *outputs.shape[1:]), np.nan)
    for column, (begin, e) in enumerate(zip(begins, experiments, strict=True)):
        measured = np.asarray(data.present)[: e.samples, :, column] > 0
        found[begin : begin + e.samples, :, column] = np.where(measured, outputs[: e.samples, :, column], np.nan)
    states = np.asarray(physical[2])
    return found, {e.name: states[:, column] for column, e in enumerate(experiments)}


def known_from(experiment: Experiment) -> int:
    """Return the sample from which on a predictor knows the state: the first measured, or soon after, where that is no start."""
    measured = int(min(np.argmax(np.isfinite(signal.values)) for signal in experiment.outputs.values()))
    return measured if measured == first_sample(experiment) else measured + _SETTLED
