"""Prediction errors across gaps, against the likelihood of normal variables with a covariance matrix of its own."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.signal

import estimators as est
import rtac_jax as rtac
from estimators.linear.model_sets import Scale, Structure, monic
from estimators.linear.predictor import Signals, prediction_errors
from rtac_jax.measurement import Experiment, Recording

COUNT = 300


@pytest.fixture(scope="module", autouse=True)
def _double() -> None:
    rtac.configure()


@pytest.mark.parametrize("order", [1, 2, 3])
def test_errors_are_those_of_the_likelihood_without_what_is_missing(order: int) -> None:
    """G is zero, H starts at rest; each sum of squares is N times that which the best variance leaves."""
    random = np.random.default_rng(order)
    structure = Structure("box_jenkins", 1, 1, order)
    reflections = random.uniform(-0.9, 0.9, 2 * order)
    theta = np.zeros(structure.count)
    theta[structure.dynamics : structure.dynamics + structure.noise] = reflections
    c, d = (np.append(1.0, monic(jnp.asarray(part))) for part in (reflections[:order], reflections[order:]))
    present = random.random(COUNT) > 0.3
    output = scipy.signal.lfilter(c, d, random.normal(size=COUNT))
    one = jnp.ones(())
    signals = Signals(
        jnp.zeros((COUNT, 1)), jnp.asarray(np.where(present, output, 0.0)), jnp.asarray(present, dtype=float), one,
        Scale(one, one, one), gaps=True,
    )  # fmt: skip
    found = np.asarray(prediction_errors(structure, jnp.asarray(theta), signals))
    impulse = scipy.signal.lfilter(c, d, np.eye(COUNT)[0])
    through = scipy.linalg.toeplitz(impulse, np.zeros(COUNT))
    covariance = (through @ through.T)[np.ix_(present, present)]
    squares = output[present] @ np.linalg.solve(covariance, output[present])
    size = np.linalg.slogdet(covariance)[1] / present.sum()
    np.testing.assert_allclose(np.sum(found**2), squares * np.exp(size), rtol=1e-9)
    assert np.all(found[~present] == 0)


def test_without_gaps_nothing_changes() -> None:
    random = np.random.default_rng(7)
    structure, one = Structure("box_jenkins", 1, 1, 2), jnp.ones(())
    theta = jnp.asarray(random.uniform(-0.5, 0.5, structure.count))
    given = (
        jnp.asarray(random.normal(size=(COUNT, 1))),
        jnp.asarray(random.normal(size=COUNT)),
        jnp.ones(COUNT),
        0.1 * one,
    )
    plain, careful = (
        prediction_errors(structure, theta, Signals(*given, Scale(one, one, one), gaps=gaps)) for gaps in (False, True)
    )
    np.testing.assert_allclose(careful, plain, rtol=1e-10, atol=1e-12)


@pytest.mark.slow
def test_deviations_and_the_variance_of_the_noise_are_right_where_a_fifth_is_missing() -> None:
    random, step = np.random.default_rng(3), 0.02
    states = scipy.signal.cont2discrete(scipy.signal.tf2ss([1.0], [1.0, 1.0, 100.0]), step)[:4]
    experiments = []
    for number in range(40):
        played = random.normal(0, 0.3, 800)
        _, position, _ = scipy.signal.dlsim((*states, step), played)
        noise = scipy.signal.lfilter([1.0, 0.3], [1.0, -1.2, 0.5], 1e-3 * random.normal(size=1000))[200:]
        measured = np.where(random.random(800) < 0.2, np.nan, position[:, 0] + noise)
        told = {"current": played, "cart_position": measured, "initial_arm_angle": 0.0}
        experiments.append(Experiment.of(f"run_{number}", kind="forced", sample_time=step, **told))
    found = est.prediction_error(Recording(tuple(experiments), {}), compensate=False, progress=False)
    assert np.mean([one.innovation_std for one in found]) == pytest.approx(1e-3, rel=0.01)
    away = np.array([(one.values[:2] - [10.0, 0.05]) / one.std[:2] for one in found])
    assert np.all(np.sqrt(np.mean(away**2, axis=0)) < 1.25)
    assert np.mean([one.residuals.white for one in found]) > 0.9
    assert found.equality().p_value > 1e-3
