"""The time loop as a function: its derivatives, what it compiles, its sine and cosine, and what it refuses."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from users_effects import Counted

from rtac_jax import RTAC, Excitation, Experiment, simulate
from rtac_jax._sincos import sincos
from rtac_jax.effect_contract import require_working_model
from rtac_jax.effects import ArmCoulomb, CubicSpring
from rtac_jax.simulation import trajectories

SAMPLES, SAMPLE_TIME = 120, 0.01


def experiment(samples: int = SAMPLES, **given: Any) -> Experiment:
    return Experiment.of("a", kind="free", sample_time=SAMPLE_TIME, cart_position=np.arange(float(samples)), **given)


def last_outputs(model: RTAC, one: Experiment) -> tuple[Any, tuple[str, ...]]:
    """Outputs at the last sample as a function of the free parameters, each relative to its value, and the start."""
    excitation, names = Excitation.of([one]), model.free
    nominal = jnp.asarray([float(model[name]) for name in names])

    def found(factors, start):
        changed = model.with_values(dict(zip(names, factors * nominal, strict=True)))
        rows = trajectories(changed, tuple(start[:, None]), excitation, samples=one.samples, substeps=4)
        return rows[-1, :, 0]

    return found, names


def assert_gradients_agree(model: RTAC, one: Experiment, start: Any) -> np.ndarray:
    found, names = last_outputs(model, one)
    factors, start = jnp.ones(len(names)), jnp.asarray(start)
    derivative = np.concatenate(jax.jit(jax.jacfwd(found, (0, 1)))(factors, start), axis=1)
    assert np.all(np.isfinite(derivative))
    call, differences = jax.jit(found), []
    for at in range(len(names)):
        step = jnp.zeros_like(factors).at[at].set(1e-6)
        differences.append((call(factors + step, start) - call(factors - step, start)) / 2e-6)
    for at, size in enumerate((1e-7, 1e-6, 1e-5, 1e-4)):
        step = jnp.zeros_like(start).at[at].set(size)
        differences.append((call(factors, start + step) - call(factors, start - step)) / (2 * size))
    expected = np.stack(differences, axis=1)
    # Each output in units of its largest derivative of a kind.
    for part in (slice(0, len(names)), *(slice(len(names) + k, len(names) + k + 1) for k in range(4))):
        size = np.max(np.abs(expected[:, part]), axis=1, keepdims=True)
        assert np.all(np.abs(derivative - expected)[:, part] < 1e-5 * size + 1e-9), part
    return derivative


def test_gradients_where_it_slides():
    current = 0.2 * np.sin(11.0 * SAMPLE_TIME * np.arange(SAMPLES))
    one = experiment(current=current, intersample="bl")
    derivative = assert_gradients_agree(
        RTAC.paper() + CubicSpring(2e4) + ArmCoulomb(5e-4), one, (0.008, 0.02, 0.7, 6.0)
    )
    assert np.all(np.any(derivative != 0, axis=0))


def test_gradients_where_it_sticks():
    """Released within the friction's band nothing depends on anything but the start."""
    found, names = last_outputs(RTAC.paper() + ArmCoulomb(5e-4), experiment())
    by_values, by_start = jax.jit(jax.jacfwd(found, (0, 1)))(jnp.ones(len(names)), jnp.asarray([1e-4, 0.0, 0.7, 0.0]))
    np.testing.assert_array_equal(by_values, np.zeros((3, len(names))))
    np.testing.assert_array_equal(by_start, [[1, 0, 0, 0], [0, 0, 0, 0], [0, 0, 1, 0]])


@pytest.mark.slow
def test_gradients_where_it_comes_to_rest():
    model = RTAC.paper().with_values({"cart_coulomb.level": 0.3})
    one = experiment(samples=300, arm="locked")
    found, names = last_outputs(model, one)
    derivative = jax.jit(jax.jacfwd(found, (0, 1)))(jnp.ones(len(names)), jnp.asarray([0.01, 0.0, 0.0, 0.0]))
    assert all(np.all(np.isfinite(part)) for part in derivative)
    assert derivative[0][0, names.index("cart_coulomb.level")] != 0


def test_values_do_not_compile_anew():
    model, one = RTAC.paper() + Counted(1.0), experiment()

    def run(model: RTAC, x: float, one: Experiment = one) -> float:
        return simulate(model, [one], start={"a": (x, 0, 0, 0)}, substeps=2)["a"].cart_position[-1]

    require_working_model(model)  # which calls it too, once for each class
    before = len(Counted.calls)
    first = run(model, 0.01)
    traced = len(Counted.calls) - before
    assert traced > 0
    assert run(model.with_values({"counted.stiffness": 20.0, "total_mass": 1.5}), 0.01) != first
    assert run(model, 0.02) != first
    # Marks of what is estimated are not part of the motion, and neither are values an experiment brings.
    run(model, 0.01, experiment(current=np.ones(SAMPLES)))
    again = len(Counted.calls)
    run(model, 0.01, experiment(current=np.full(SAMPLES, 2.0)))
    assert len(Counted.calls) == again
    assert again - before == 2 * traced, "a current where there was none is compiled once"


# -- sine and cosine -----------------------------------------------------------------------------------------------


def test_sincos_is_exact():
    angles = np.random.default_rng(0).uniform(-1e4, 1e4, 100_000)
    angles = np.concatenate([angles, angles / 1e4, np.pi / 4 * np.arange(-40, 41), [0.0, 1e-300, -1e-9]])
    sine, cosine = (np.asarray(part) for part in jax.jit(sincos)(jnp.asarray(angles)))
    np.testing.assert_allclose(sine, np.sin(angles), rtol=0, atol=4.5e-16)
    np.testing.assert_allclose(cosine, np.cos(angles), rtol=0, atol=4.5e-16)
    near = np.abs(angles) < 0.5
    np.testing.assert_allclose(sine[near], np.sin(angles[near]), rtol=4.5e-16)


def test_sincos_derivatives():
    angles = jnp.asarray(np.random.default_rng(1).uniform(-100, 100, 1000))
    ones = jnp.ones_like(angles)
    (sine, cosine), (slope_sine, slope_cosine) = jax.jvp(sincos, (angles,), (ones,))
    np.testing.assert_allclose(slope_sine, cosine, rtol=0, atol=0)
    np.testing.assert_allclose(slope_cosine, -sine, rtol=0, atol=0)
    second = jax.vmap(jax.grad(jax.grad(lambda x: sincos(x)[0])))(angles)
    np.testing.assert_allclose(second, -np.sin(angles), rtol=0, atol=1e-15)


# -- what it refuses, and what it survives -------------------------------------------------------------------------


@pytest.mark.parametrize("start", [(-0.5, 0.0, 0.3, 0.0), (0.5, 5.0, 0.3, 0.0)])
def test_divergence_shows_as_numbers_that_are_not_finite(start):
    """A softening spring has a far side from which nothing returns."""
    found = simulate(RTAC.paper() + CubicSpring(-1e5), [experiment()], start={"a": start})["a"]
    assert np.all(np.isfinite(found.cart_position[:3]))
    assert not np.isfinite(found.cart_position[-1])
    assert found.cart_position.shape == (SAMPLES,)


@pytest.mark.parametrize("start", [(0.0, 0.0, 0.0), (0.0,) * 5, np.zeros(()), np.zeros((1, 4))])
def test_start_of_wrong_length_is_refused(start):
    with pytest.raises(ValueError, match=r"start of experiment a has shape .*; give 4 or 4 numbers"):
        simulate(RTAC.paper(), [experiment()], start={"a": start})


def test_no_experiment_is_refused():
    with pytest.raises(ValueError, match="at least one experiment"):
        simulate(RTAC.paper(), [])


def test_start_without_a_mention_is_rest_at_the_given_angle():
    found = simulate(RTAC.paper(), [experiment(initial_arm_angle=0.7)])["a"]
    assert np.all(found.arm_angle == 0.7)
    assert np.all(found.cart_position == 0)
