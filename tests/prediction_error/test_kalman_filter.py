"""The filter of the nonlinear model, where the rig is linear, held against the textbook's."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from exact_decay import MASS, STIFFNESS, VISCOUS
from scipy.linalg import expm

import rtac_jax as rtac
from estimators.core.data import Data
from estimators.core.initial_state import space_of
from estimators.prediction_error.ekf import filtered


def test_kalman_filter_agrees_with_one_for_linear_systems() -> None:
    """A locked arm and no dry friction make a linear oscillator, for which the textbook filter is written out here."""
    random = np.random.default_rng(3)
    dt, count, density, sensor = 0.01, 300, 1e-4, 2e-5
    force = random.normal(size=count) * 0.1
    a = np.array([[0.0, 1.0], [-STIFFNESS / MASS, -VISCOUS / MASS]])
    block = expm(np.block([[a, np.array([[0.0], [1 / MASS]])], [np.zeros((1, 3))]]) * dt)
    f, g = block[:2, :2], block[:2, 2]
    x, measured = np.array([0.003, 0.0]), []
    push = np.array([0.0, 1 / MASS])
    for k in range(count):
        measured.append(x[0] + sensor * random.normal())
        x = f @ x + g * force[k] + push * np.sqrt(density * dt) * random.normal()
    experiment = rtac.Experiment.of(
        "a", kind="forced", sample_time=dt, disturbance_force=force, cart_position=np.array(measured), arm="locked"
    )
    model = rtac.RTAC.from_rig(rtac.Recording((experiment,), rig={})).without("cart_coulomb")
    space = space_of(model, [experiment], free=[], start={"a": np.array([0.003, 0.0, 0.0, 0.0])})
    data = Data.of([experiment])
    # A third of the samples is followed and does not count.
    counts = (np.arange(count) % 3 > 0).astype(float)
    found, some = (
        filtered(
            model, dataclasses.replace(data, trusted=trusted), space, space.physical(space.unconstrained(start=False)),
            sensor_variance=jnp.full((3, 1), sensor**2), process=(jnp.asarray(density), jnp.asarray(0.0)),
            start_variance=jnp.asarray([[1e-8], [1e-6], [0.0], [0.0]]), substeps=8,
        )
        for trusted in (data.trusted, data.trusted.at[:count, 0].set(counts))
    )  # fmt: skip

    state, spread, likelihood, counted = np.array([0.003, 0.0]), np.diag([1e-8, 1e-6]), 0.0, 0.0
    half = 0.5 * dt * density * np.outer(push, push)
    for k in range(count):
        variance = spread[0, 0] + sensor**2
        error = measured[k] - state[0]
        gain = spread[:, 0] / variance
        assert float(found.innovations[k, 0, 0]) == pytest.approx(error / np.sqrt(variance), abs=1e-5)
        np.testing.assert_allclose(np.asarray(found.gain[k, :2, 0, 0]), gain, rtol=1e-5)
        assert float(some.innovations[k, 0, 0]) == pytest.approx(counts[k] * error / np.sqrt(variance), abs=1e-5)
        np.testing.assert_allclose(np.asarray(some.gain[k, :2, 0, 0]), gain, rtol=1e-5)
        likelihood -= 0.5 * (error**2 / variance + np.log(variance))
        counted -= 0.5 * counts[k] * (error**2 / variance + np.log(variance))
        state = f @ (state + gain * error) + g * force[k]
        spread = f @ (spread - np.outer(gain, spread[0]) + half) @ f.T + half
    assert float(found.log_likelihood[0]) == pytest.approx(likelihood, rel=1e-6)
    assert float(some.log_likelihood[0]) == pytest.approx(counted, rel=1e-6)
    assert not np.any(np.asarray(some.whitener)[:count][counts == 0])
