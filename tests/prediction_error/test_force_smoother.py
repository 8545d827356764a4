"""The smoothed missing force against a Gaussian process by dense linear algebra, in plain NumPy."""

import jax.numpy as jnp
import numpy as np
import pytest

from estimators.core.data import Data
from estimators.prediction_error.ekf import Wander
from estimators.prediction_error.force_smoother import LinearPath, likelihoods, smoothed
from rtac_jax.measurement import Experiment

LENGTHS, SAMPLE_TIME, STATES = (40, 25), 0.01, 3
SIZES = np.array([0.7, 0.3])  # of the forces on cart and arm
CORRELATION_TIME = 0.05


def recorded() -> tuple[Data, LinearPath]:
    """Return errors of two experiments of unequal lengths, with a gap in one, and a linear model that changes with time."""
    random = np.random.default_rng(1)
    several = []
    for n, count in enumerate(LENGTHS):
        values = random.normal(size=count)
        values[10:13] = np.nan if n == 0 else values[10:13]
        several.append(
            Experiment.of(f"free_{n}", kind="free", sample_time=SAMPLE_TIME, cart_position=values, arm="locked")
        )
    data = Data.of(several)
    room, count = data.room, len(LENGTHS)
    transition = 0.9 * np.eye(STATES)[None, :, :, None] + 0.1 * random.normal(size=(room, STATES, STATES, count))
    shown = np.zeros((room, 3, STATES, count))
    shown[:, 0] = random.normal(size=(room, STATES, count))
    linear = LinearPath(
        transition=jnp.asarray(transition), push=jnp.asarray(random.normal(size=(room, STATES, 2, count))),
        shown=jnp.asarray(shown), error=data.values * data.present,
        wander=Wander(jnp.full((3, count), 0.04), jnp.zeros((STATES, count)), jnp.zeros((STATES, count)), ()),
        begin=jnp.asarray(random.uniform(0.1, 1.0, (STATES, count))), interval=jnp.full(count, SAMPLE_TIME),
    )  # fmt: skip
    return data, linear


def dense(data: Data, linear: LinearPath, column: int, swing: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return mean and variance of both forces given all outputs of an experiment, and the logarithm of their density."""
    count = LENGTHS[column]
    apart = SAMPLE_TIME * np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    of_one = np.exp(-apart / CORRELATION_TIME) * np.cos(swing * apart)
    prior = np.kron(np.diag(SIZES**2), of_one)  # cart first
    by_start, by_force = np.eye(STATES), np.zeros((STATES, 2 * count))
    rows = []
    for k in range(count):
        h = np.asarray(linear.shown)[k, 0, :, column]
        rows.append(np.concatenate([h @ by_start, h @ by_force]))
        f, push = np.asarray(linear.transition)[k, :, :, column], np.asarray(linear.push)[k, :, :, column]
        by_start, by_force = f @ by_start, f @ by_force
        by_force[:, k] += push[:, 0]
        by_force[:, count + k] += push[:, 1]
    there = np.asarray(data.present)[:count, 0, column] > 0
    shown, y = np.stack(rows)[there], np.asarray(linear.error)[:count, 0, column][there]
    joint = np.zeros((STATES + 2 * count, STATES + 2 * count))
    joint[:STATES, :STATES] = np.diag(np.asarray(linear.begin)[:, column])
    joint[STATES:, STATES:] = prior
    spread = shown @ joint @ shown.T + 0.04 * np.eye(len(y))
    across = (joint @ shown.T)[STATES:]
    mean = across @ np.linalg.solve(spread, y)
    variance = np.diagonal(prior) - np.sum(across * np.linalg.solve(spread, across.T).T, axis=1)
    density = -0.5 * (y @ np.linalg.solve(spread, y) + np.linalg.slogdet(spread)[1])
    return mean.reshape(2, count).T, variance.reshape(2, count).T, float(density)


@pytest.mark.parametrize("swing", [0.0, 40.0])
def test_forces_and_their_likelihood_are_those_of_a_gaussian_process(swing: float) -> None:
    data, linear = recorded()
    gain = jnp.zeros((data.room, STATES, 3, len(LENGTHS)))
    time, turn = jnp.asarray(CORRELATION_TIME), jnp.asarray(swing)
    mean, variance = smoothed(linear, data, gain, jnp.asarray(SIZES), time, turn)
    likelihood = likelihoods(linear, data, gain, jnp.asarray(SIZES)[None], time, turn)
    expected = [dense(data, linear, column, swing) for column in range(len(LENGTHS))]
    for column, (force, doubt, _) in enumerate(expected):
        count = LENGTHS[column]
        np.testing.assert_allclose(np.asarray(mean)[:count, :, column], force, rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(np.asarray(variance)[:count, :, column], doubt, rtol=1e-8, atol=1e-10)
    assert float(likelihood[0]) == pytest.approx(sum(density for *_, density in expected), rel=1e-9)
