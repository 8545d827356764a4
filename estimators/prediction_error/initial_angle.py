"""The angle of the arm where an experiment begins that tells nothing of it: the one that makes its predictions most likely."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from estimators.core.data import Data
from estimators.core.initial_angle import ANGLE, CIRCLE, angle_unknown
from estimators.core.parameter_space import Space
from estimators.prediction_error.filter_pass import run_filter
from estimators.prediction_error.noise_estimation import first_noise
from estimators.prediction_error.noise_model import NoiseModel
from rtac_jax import RTAC
from rtac_jax.simulation import Steps

_SAMPLES = 2000  # of each experiment that are predicted from every angle
_FINER = 3  # times that the two steps beside the likeliest angle are halved: to a twentieth of a radian


def with_likeliest_angles(model: RTAC, data: Data, space: Space, prior: NoiseModel, substeps: Steps) -> Space:
    """Return the space with the arm begun where the filter finds the data most likely, where an experiment does not tell.

    Angles around the circle are tried in all experiments at once, and then those beside the likeliest of each. The filter
    knows each but for half the step between them.

    Args:
        model: that is fitted.
        data: of all experiments.
        space: of the unknowns, at the values where a fit begins.
        prior: knowledge of the noise.
        substeps: Runge-Kutta steps per sample.
    """
    blind = angle_unknown(space)
    if not blind.any():
        return space
    data = dataclasses.replace(data, length=jnp.minimum(data.length, _SAMPLES))
    shared, each, start = (np.asarray(part) for part in space.physical(space.unconstrained(start=False)))

    def likelihood(angles: Float[np.ndarray, " experiment"], step: float) -> Float[np.ndarray, " experiment"]:
        there = start.copy()
        there[ANGLE] = np.where(blind, angles, start[ANGLE])
        variance = np.asarray(prior.start_variance).copy()
        variance[ANGLE] = np.where(blind, (0.5 * step) ** 2, variance[ANGLE])
        known = dataclasses.replace(prior, start_variance=jnp.asarray(variance))
        physical = (jnp.asarray(shared), jnp.asarray(each), jnp.asarray(there))
        found = np.asarray(run_filter(model, data, space, physical, known, first_noise(), substeps).log_likelihood)
        return np.where(np.isfinite(found), found, -np.inf)

    step = 2 * np.pi / len(CIRCLE)
    tried = np.stack([likelihood(np.full(len(blind), angle), step) for angle in CIRCLE])
    best = CIRCLE[np.argmax(tried, axis=0)]
    for _ in range(_FINER):
        step *= 0.5
        beside = np.stack([best - step, best, best + step])
        nearer = np.stack([likelihood(angles, step) for angles in beside])
        best = beside[np.argmax(nearer, axis=0), np.arange(len(blind))]
    found = start.copy()
    found[ANGLE] = np.where(blind, best, start[ANGLE])
    return dataclasses.replace(space, start=jnp.asarray(found))
