"""Derivatives of the filter's likelihood by its noise, beside differences of the likelihood."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from estimators.core.data import Data
from estimators.core.initial_state import space_of
from estimators.prediction_error.coloured_noise import with_colours
from estimators.prediction_error.ekf import filtered, kalman
from estimators.prediction_error.noise_model import start_variance
from estimators.prediction_error.noise_score import noise_information, noise_slope
from rtac_jax import RTAC, Experiment

SENSOR = np.array([2e-5, 0.05, 1.0])
COLOUR = {"cart_position": (0.6, 0.02)}


def recorded(random: np.random.Generator, samples: int) -> Experiment:
    """Of a locked arm and viscous friction, so that the filter is linear and all its derivatives are exact."""
    walk = 1e-3 * np.cumsum(random.normal(size=samples)) / np.sqrt(samples)
    values = np.where(random.random(samples) < 0.1, np.nan, walk)
    return Experiment.of(f"e{samples}", kind="free", sample_time=0.01, cart_position=values, arm="locked")


@pytest.mark.parametrize("colour", [{}, COLOUR])
def test_slopes_are_those_of_the_likelihood(colour):
    random = np.random.default_rng(5)
    experiments = [recorded(random, 150), recorded(random, 110)]
    model = RTAC.paper().without("cart_coulomb")
    model = with_colours(model, colour)
    space, data = space_of(model, experiments, free=[]), Data.of(experiments)
    data = dataclasses.replace(data, trusted=data.trusted.at[40:55].set(0.0))
    physical = space.physical(space.unconstrained(start=False))

    def noise(at):
        variance = jnp.broadcast_to((jnp.exp(at[2:]) * SENSOR**2)[:, None], (3, data.experiments))
        process = (jnp.exp(at[0]) * 1e-4, jnp.exp(at[1]) * 1e-8)
        return {"sensor_variance": variance, "process": process, "start_variance": start_variance(space)}

    def value(at):
        return -filtered(model, data, space, physical, **noise(at), substeps=1).log_likelihood.sum()

    @eqx.filter_jit
    def sloped(at):
        found, linear = kalman(model, data, space, physical, **noise(at), substeps=1)
        given = found, linear, data.length
        return -found.log_likelihood.sum(), noise_slope(*given).sum(axis=1), noise_information(*given).sum(axis=2)

    at = jnp.asarray([0.3, -0.2, 0.5, 0.1, 0.0])
    total, slope, information = map(np.asarray, sloped(at))
    assert float(total) == pytest.approx(float(value(at)), rel=1e-12)
    step = 1e-4
    differences = [(value(at + d) - value(at - d)) / (2 * step) for d in step * jnp.eye(5)]
    assert np.all(np.abs(slope[[0, 2]]) > 1.0)
    np.testing.assert_allclose(slope, differences, rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(information, information.T, rtol=1e-12)
    assert information[0, 0] > 0
    assert information[2, 2] > 0
