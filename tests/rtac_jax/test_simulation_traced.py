"""Simulation under jit, vmap, jacfwd and grad, and of inputs without a recording."""

import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from users_effects import Counted

import rtac_jax as rtac
from rtac_jax import RTAC, Excitation, Experiment, Simulation
from rtac_jax._spline import spline_coefficients
from rtac_jax._substeps_traced import substeps_traced
from rtac_jax.effects import CATALOGUE, CubicSpring
from rtac_jax.excitation import coefficients
from rtac_jax.parameters import declarations
from rtac_jax.simulation import substeps_for

SAMPLES, SAMPLE_TIME = 100, 0.01
CURRENT = 0.2 * np.sin(11.0 * SAMPLE_TIME * np.arange(SAMPLES))
START = np.array([0.008, 0.02, 0.7, 6.0])
RECORDED = np.arange(float(SAMPLES))
EXPERIMENT = Experiment.of(
    "a", kind="forced", sample_time=SAMPLE_TIME, cart_position=RECORDED, current=CURRENT, intersample="bl"
)
SHORT = Experiment.of("b", kind="free", sample_time=0.02, cart_position=RECORDED[:60], initial_arm_angle=0.4)


MODEL = RTAC.paper() + CubicSpring(2e4) + Counted(1.0)
NAMES = MODEL.free
NOMINAL = jnp.asarray([float(MODEL[name]) for name in NAMES])
FACTORS = jnp.ones(len(NAMES))


def simulated(factors: Any, start: Any) -> Any:
    model = MODEL.with_values(dict(zip(NAMES, factors * NOMINAL, strict=True)))
    return rtac.simulate(model, [EXPERIMENT, SHORT], start={"a": start})


def misfit(factors: Any, start: Any) -> Any:
    found = simulated(factors, start)
    squares = [jnp.sum(jnp.square(1e3 * one.cart_position)) + jnp.sum(one.arm_velocity**2) for one in found.values()]
    return sum(squares) / SAMPLES


# Compiled once, for two tests.
BACKWARDS, FORWARDS = jax.grad(misfit, (0, 1)), jax.jit(jax.jacfwd(misfit, (0, 1)))


def central_differences(function: Any, at: np.ndarray, sizes: Any) -> np.ndarray:
    """Of fourth order."""
    columns = []
    for place, size in enumerate(np.broadcast_to(sizes, at.shape)):
        step = np.zeros_like(at)
        step[place] = size
        near = np.asarray(function(at + step)) - np.asarray(function(at - step))
        far = np.asarray(function(at + 2 * step)) - np.asarray(function(at - 2 * step))
        columns.append((8 * near - far) / (12 * size))
    return np.stack(columns, axis=-1)


def test_derivatives_in_both_directions_equal_finite_differences():
    call = jax.jit(misfit)
    gradients = BACKWARDS(FACTORS, START)
    by_factor = central_differences(lambda x: call(x, START), np.asarray(FACTORS), 1e-4)
    by_start = central_differences(lambda x: call(FACTORS, x), START, 1e-3 * np.abs(START))
    for found, expected in zip(gradients, (by_factor, by_start), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-6)
        assert np.all(expected != 0)
    forward = FORWARDS(FACTORS, START)
    for found, other in zip(gradients, forward, strict=True):
        np.testing.assert_allclose(found, other, rtol=1e-10)


@pytest.mark.slow
def test_a_hessian_is_the_difference_of_gradients():
    gradient = jax.jit(jax.grad(misfit, 1))
    found = jax.jit(jax.jacfwd(jax.grad(misfit, 1), 1))(FACTORS, START)
    expected = central_differences(lambda x: gradient(FACTORS, x), START, 1e-3 * np.abs(START))
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6 * np.max(np.abs(expected)))


def test_compiled_simulation_is_the_simulation():
    plain, compiled = simulated(FACTORS, START), jax.jit(simulated)(FACTORS, START)
    assert list(compiled) == ["a", "b"]
    for name, one in plain.items():
        assert isinstance(one, Simulation)
        assert isinstance(one.cart_position, np.ndarray)
        for other, expected in zip(jax.tree.leaves(compiled[name]), jax.tree.leaves(one), strict=True):
            np.testing.assert_allclose(other, expected, rtol=1e-11, atol=1e-13)
    alone = rtac.simulate(MODEL, EXPERIMENT, start={"a": START})
    np.testing.assert_array_equal(alone.time, EXPERIMENT.time)


@pytest.mark.slow
def test_a_batch_of_64_parameter_sets_equals_one_by_one():
    sets = 1.0 + 0.2 * np.random.default_rng(3).uniform(-1, 1, (64, len(NAMES)))
    batch = jax.jit(jax.vmap(simulated, (0, None)))(jnp.asarray(sets), START)
    assert batch["a"].cart_position.shape == (64, SAMPLES)
    for number, factors in enumerate(sets):
        for name, one in simulated(factors, START).items():
            for channel in ("cart_position", "arm_velocity"):
                found, expected = getattr(batch[name], channel)[number], getattr(one, channel)
                np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10 * np.max(np.abs(expected)))
    assert np.ptp(batch["a"].cart_position[:, -1]) > 1e-4
    gradients = jax.jit(jax.vmap(jax.grad(misfit), (0, None)))(jnp.asarray(sets[:4]), START)
    np.testing.assert_allclose(gradients[3], jax.grad(misfit)(jnp.asarray(sets[3]), START), rtol=1e-9)


def test_a_stiff_member_of_a_batch_sets_the_steps_of_all():
    stiffness = jnp.asarray([132.6, 5e4])
    excitation = Excitation.of([EXPERIMENT])

    def steps(value: Any) -> Any:
        return substeps_traced(MODEL.with_values({"spring_stiffness": value}), excitation, stability=0.5, most=64)

    alone = [
        substeps_for(MODEL.with_values({"spring_stiffness": x}), excitation, stability=0.5) for x in (132.6, 5e4, 1e9)
    ]
    assert alone[0] < alone[1] < alone[2] == 64
    assert [int(jax.jit(steps)(x)) for x in (132.6, 5e4, 1e9)] == alone
    np.testing.assert_array_equal(jax.vmap(steps)(stiffness), [alone[1]] * 2)


@pytest.mark.parametrize(
    "function",
    [
        pytest.param(BACKWARDS, id="backwards"),
        pytest.param(FORWARDS, id="forwards"),
        pytest.param(jax.grad(misfit), id="by factors", marks=pytest.mark.slow),
        pytest.param(jax.jit(jax.jacfwd(misfit)), id="by factors, forwards", marks=pytest.mark.slow),
        pytest.param(jax.grad(misfit, 1), id="by the start", marks=pytest.mark.slow),
    ],
)
def test_values_compile_nothing_anew(function):
    function(FACTORS, START)
    before = len(Counted.calls)
    first, other = (jax.tree.leaves(function(*at)) for at in ((FACTORS, START), (1.1 * FACTORS, 0.9 * START)))
    assert all(np.any(one != two) for one, two in zip(first, other, strict=True))
    assert len(Counted.calls) == before
    assert before > 0


@pytest.mark.parametrize(
    "intersample", [*(pytest.param(hold, marks=pytest.mark.slow) for hold in ("zoh", "foh")), "bl"]
)
def test_inputs_without_a_recording_move_the_rig_as_in_one(intersample):
    inputs = {"current": CURRENT, "disturbance_force": 0.4 * np.cos(7.0 * SAMPLE_TIME * np.arange(SAMPLES))}
    one = Experiment.of(
        "a", kind="forced", sample_time=SAMPLE_TIME, cart_position=RECORDED, intersample=intersample, **inputs
    )
    # One whose inputs act on after their end, and before it.
    model = RTAC.paper() + rtac.effects.InputHold(0.5, 3.0)
    expected = rtac.simulate(model, one, start={"a": START}, substeps=2)
    found = rtac.simulate_inputs(
        model, **inputs, sample_time=SAMPLE_TIME, start=START, intersample=intersample, substeps=2
    )
    for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-14)


@pytest.mark.slow
def test_gradient_by_every_sample_of_an_input_and_by_the_sample_time():
    def last_position(current: Any, sample_time: Any) -> Any:
        found = rtac.simulate_inputs(
            RTAC.paper(), current=current, sample_time=sample_time, start=START, intersample="bl", substeps=2
        )
        return 1e3 * found.cart_position[-1]

    current = CURRENT[:40]
    found = jax.jit(jax.grad(last_position, (0, 1)))(current, SAMPLE_TIME)
    along = np.random.default_rng(5).standard_normal(40)
    size = np.array([1e-3])
    expected = central_differences(lambda x: last_position(current + x[0] * along, SAMPLE_TIME), 0 * size, size)
    np.testing.assert_allclose(found[0] @ along, expected[0], rtol=1e-6)
    expected = central_differences(lambda x: last_position(current, SAMPLE_TIME + x[0]), 0 * size, 1e-5)
    np.testing.assert_allclose(found[1], expected[0], rtol=1e-6)


def test_the_spline_is_scipys():
    signal = EXPERIMENT.inputs["current"]
    np.testing.assert_allclose(spline_coefficients(jnp.asarray(signal.values)), coefficients(signal), atol=1e-15)


def test_what_moves_without_an_input():
    found = rtac.simulate_inputs(RTAC.paper(), sample_time=0.005, samples=50, start=(0.01, 0, 0.3, 0), arm="locked")
    assert found.cart_position.shape == (50,)
    assert found.cart_position[0] == 0.01
    assert found.cart_position[-1] < 0.01
    assert np.all(found.arm_angle == 0.3)
    assert found.time[-1] == pytest.approx(49 * 0.005)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "samples is not given"),
        ({"current": [1.0, 2.0], "samples": 3}, "lengths differ: current 2, samples 3"),
        ({"current": [[1.0, 2.0]]}, r"current has shape \(1, 2\)"),
        ({"current": [1.0, np.nan]}, "current, sample 1: is not a finite number"),
        ({"current": [1.0, 2.0], "intersample": "bl"}, "needs at least 4"),
        ({"samples": 9, "intersample": "held"}, "intersample is 'held'; use one of zoh, foh, bl"),
        ({"samples": 9, "arm": "loose"}, "arm is 'loose'"),
        ({"samples": 9, "sample_time": 0.0}, r"sample_time \[s\] is 0.0"),
        ({"samples": 9, "start": (0.0, 1.0)}, r"start of the simulation has shape \(2,\); give 4 or 4 numbers"),
        ({"samples": 0}, "there is no sample"),
    ],
)
def test_inputs_that_make_no_sense_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        rtac.simulate_inputs(RTAC.paper(), **{"sample_time": 0.01, **given})


@pytest.mark.slow
def test_single_precision_is_said_once():
    code = (
        "import warnings, rtac_jax as r\n"
        "with warnings.catch_warnings(record=True) as said:\n"
        "    warnings.simplefilter('always')\n"
        "    for _ in range(2):\n"
        "        one = r.simulate_inputs(r.RTAC.paper(), sample_time=0.01, samples=20, start=(0.01, 0, 0, 0))\n"
        "print([str(w.message) for w in said], one.cart_position.dtype)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.count("single precision") == 1
    assert "rtac_jax.configure()" in done.stdout
    assert "float32" in done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("effect_id", sorted(CATALOGUE))
def test_reverse_derivatives_of_every_effect_are_its_forward_ones(effect_id):
    model = RTAC.paper()
    if effect_id not in model:
        effect = CATALOGUE[effect_id]
        scales = rtac.Scales(5e-3, 0.05, 15.0, 0.15, 0.7, 0.012, 10.4, 1.23, SAMPLE_TIME)
        values = {}
        for name, declared in declarations(effect).items():
            guess = declared.plausible(scales) if declared.plausible else 0.1
            values[name] = guess[0] if isinstance(guess, tuple) else guess
        model = model + effect(**values)
    names = tuple(name for name in model.parameters if np.ndim(model[name]) == 0)
    nominal = jnp.asarray([float(model[name]) for name in names])

    def spread(values: Any, start: Any) -> Any:
        one = rtac.simulate(
            model.with_values(dict(zip(names, values, strict=True))), EXPERIMENT, start={"a": start}, substeps=4
        )
        return jnp.sum((1e3 * one.cart_position) ** 2) + jnp.sum(one.arm_velocity**2) + jnp.sum(one.arm_angle**2)

    backwards = jax.jit(jax.grad(spread, (0, 1)))(nominal, START)
    forwards = jax.jit(jax.jacfwd(spread, (0, 1)))(nominal, START)
    for found, expected in zip(backwards, forwards, strict=True):
        assert np.all(np.isfinite(expected))
        np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-12)
