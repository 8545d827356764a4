"""The distance by which random forces carry a simulation away: the covariance of a filter that is not corrected."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from estimators.core.data import CHANNELS, Data, motion_of
from estimators.core.fit import Fit
from estimators.core.parameter_space import Physical, Space
from estimators.inference.simulation_residual import SimulationLimits
from estimators.prediction_error.filter_pass import all_trusted, run_filter
from estimators.prediction_error.fit import PredictorFit
from estimators.prediction_error.noise_model import NoiseModel
from rtac_jax import RTAC
from rtac_jax.simulation import Steps

# Weight of a measurement in a filter that is to ignore it: its gain falls with the square, far below rounding of any residual.
_IGNORED = 1e-6


def simulation_deviation(
    model: RTAC, data: Data, space: Space, physical: Physical, prior: NoiseModel, noise: np.ndarray, substeps: Steps
) -> Float[np.ndarray, " output"]:
    """Return the rms error that random forces and sensor noise give a free simulation, per output, SI units.

    The covariance is propagated along the simulation by the filter's own compiled pass, whose measurements have no weight, from
    starts that are known. NaN for an output that nobody measured. A fit of starts and parameters absorbs a part of this.

    Args:
        model: that is simulated.
        data: whose inputs act on it.
        space: of its unknowns.
        physical: all parameters and the states at the start, along which to linearise.
        prior: noise to which `noise` is relative.
        noise: as `run_filter` takes it.
        substeps: Runge-Kutta steps per sample.

    Source: Jazwinski, Stochastic Processes and Filtering Theory (1970), chapter 8, prediction without measurement update.
    """
    known = dataclasses.replace(prior, start_variance=jnp.zeros_like(prior.start_variance))
    ignored = dataclasses.replace(all_trusted(data), present=_IGNORED * data.present)
    passed = run_filter(model, ignored, space, physical, known, noise, substeps)
    weights = np.moveaxis(np.diagonal(np.asarray(passed.whitener), axis1=1, axis2=2), -1, 1)
    present = np.asarray(data.present) > 0
    # The whitener's diagonal is the weight squared over the deviation.
    variance = np.where(present, (_IGNORED**2 / np.where(present, weights, 1.0)) ** 2, 0.0)
    count = present.sum(axis=(0, 2))
    return np.sqrt(np.where(count > 0, variance.sum(axis=(0, 2)) / np.maximum(count, 1), np.nan))


def shaken_by(
    fit: PredictorFit, start: Float[np.ndarray, "start experiment"]
) -> tuple[Float[np.ndarray, " output"], tuple[float, float]]:
    """Return `simulation_deviation` of a predictor, and its random force and torque in one sample as fractions of the rms forces.

    Args:
        fit: the predictor.
        start: states at the start, along whose simulation to linearise.
    """
    a = fit.problem.arguments
    shared, each, _ = a.space.physical(fit.problem.unknowns)
    physical = (shared, each, jnp.asarray(start))
    left = simulation_deviation(a.model, a.data, a.space, physical, fit.prior, fit.noise_exponents, a.substeps)
    force, torque = np.exp(0.5 * fit.noise_exponents[:2])
    return left, (float(force), float(torque))


def unfollowed(fit: Fit, data: Data, limits: SimulationLimits) -> float:
    """Return the rms error of a fit's simulation over the rms of the motion, of the channel where that is most.

    Only channels count in which the model misses more than the sensor does.

    Args:
        fit: whose simulation it is.
        data: that it was fitted to.
        limits: say from which error on that is so.
    """
    signal = motion_of(data)
    found = [
        error / signal[CHANNELS.index(channel)]
        for channel, error in fit.residual_std.items()
        if error**2 > limits.beyond * fit.noise[channel] ** 2 and signal[CHANNELS.index(channel)] > 0
    ]
    return float(max(found, default=0.0))
