"""Derivatives of the filter's likelihood by its noise, beside differences of the likelihood."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from estimators.core.data import Data
from estimators.core.initial_state import space_of
from estimators.core.residual import states_at_start
from estimators.prediction_error.coloured_noise import with_colours
from estimators.prediction_error.ekf import filtered, kalman
from estimators.prediction_error.noise_model import start_variance
from estimators.prediction_error.noise_score import noise_information, noise_slope
from rtac_jax import RTAC, Experiment
from rtac_jax.simulation import advance

SENSOR = np.array([2e-5, 0.05, 1.0])
COLOUR = {"cart_position": (0.6, 0.02)}


def recorded(random: np.random.Generator, samples: int) -> Experiment:
    """Of a locked arm and viscous friction, so that the filter is linear and all its derivatives are exact."""
    walk = 1e-3 * np.cumsum(random.normal(size=samples)) / np.sqrt(samples)
    values = np.where(random.random(samples) < 0.1, np.nan, walk)
    return Experiment.of(f"e{samples}", kind="free", sample_time=0.01, cart_position=values, arm="locked")


@pytest.mark.parametrize("colour", [pytest.param({}, marks=pytest.mark.slow), COLOUR])
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


@pytest.mark.slow
def test_where_a_state_is_sure_its_derivatives_are_those_of_the_model():
    """Of a cart that slides and an arm that turns, with dry friction; the velocities' are differences over next to nothing."""
    motion = {"cart_position": np.linspace(0.01, 0.02, 8), "arm_velocity": np.linspace(4.0, 3.9, 8)}
    experiments = [Experiment.of("e", kind="free", sample_time=0.01, initial_arm_angle=0.7, **motion)]
    model = RTAC.paper()
    data = Data.of(experiments)
    space = space_of(model, experiments, free=[], start={"e": np.array([0.01, 0.3, 0.7, 4.0])})
    physical = space.physical(space.unconstrained(start=False))
    sure, loud = jnp.zeros_like(start_variance(space)), jnp.full((3, 1), 1e6)

    @eqx.filter_jit
    def transition():
        given = {"sensor_variance": loud, "process": (0.0, 0.0), "start_variance": sure}
        return kalman(model, data, space, physical, **given, substeps=1)[1].transition[0, :, :, 0]

    def onward(state):
        current, force = (None if x is None else tuple(x[0]) for x in (data.excitation.current, data.excitation.force))
        at = tuple(x[None] for x in state)
        return jnp.stack(advance(model, at, current, force, data.excitation, substeps=1))[:, 0]

    begun = jnp.array([x[0] for x in states_at_start(model, physical[2], data.excitation)])
    assert np.all(np.abs(np.asarray(begun)[[1, 3]]) > 0.1), "or else a body may rest"
    np.testing.assert_allclose(transition(), jax.jacfwd(onward)(begun), rtol=1e-5, atol=1e-7)
