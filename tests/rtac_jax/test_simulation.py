"""The time loop against other integrators, exact solutions, conservation laws and itself."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import cumulative_simpson, solve_ivp
from scipy.interpolate import CubicSpline

from rtac_jax import RTAC, Excitation, Experiment, RigidBody, simulate
from rtac_jax._adjoint import differentiable_states
from rtac_jax.effects import ArmCoulomb, ArmViscous, CartCoulomb, CartViscous, FlexibleMode
from rtac_jax.simulation import UNROLLED, trajectories
from rtac_jax.virtual_rig import Plan, Rig, standard_plans
from rtac_jax.virtual_rig._motion import integrate

M, J, ME, K, KM = 1.23, 9.5e-5, 1.06e-3, 132.6, 8.04e-2
VISCOUS, KV = 0.5543, 1.44e-4
BODY = RigidBody(M, J, ME, K, KM)
SMOOTH = RTAC(BODY, (CartViscous(VISCOUS), ArmViscous(KV, KV)))
RIGID = ("cart_position", "cart_velocity", "arm_angle", "arm_velocity")
START = (0.008, 0.02, 0.7, 6.0)


def experiment(name: str = "a", *, samples: int, sample_time: float, **given: Any) -> Experiment:
    outputs = {"cart_position": np.arange(float(samples))}
    return Experiment.of(name, kind="free", sample_time=sample_time, **outputs, **given)


def run(model: RTAC, one: Experiment, start: Any, substeps: int) -> np.ndarray:
    """(N, 4) rigid states."""
    found = simulate(model, [one], start={one.name: start}, substeps=substeps)[one.name]
    return np.stack([found.states[name] for name in RIGID], axis=1)


def assert_close(found: np.ndarray, expected: np.ndarray, bound: float) -> None:
    """Largest difference of each column, relative to its largest value."""
    size = np.max(np.abs(expected), axis=0)
    np.testing.assert_array_less(np.max(np.abs(found - expected), axis=0), bound * np.where(size > 0, size, 1.0))


def reference(one: Experiment, start: Any, *, pieces: int, forwards: float = KV, backwards: float = KV) -> np.ndarray:
    """(N, 4) states by DOP853, from equations (1) and (2), in pieces of some samples between which inputs may jump."""
    arm, cart, last = one.arm == "free", one.cart == "free", one.samples - 1

    def between(channel: str) -> Any:
        signal = one.inputs.get(channel)
        if signal is None:
            return lambda t, begin: 0.0
        if signal.intersample == "zoh":
            return lambda t, begin: signal.values[begin]
        if signal.intersample == "foh":
            return lambda t, begin: np.interp(t, one.time, signal.values)
        spline = CubicSpline(one.time, signal.values)
        return lambda t, begin: float(spline(t))

    current, force = between("current"), between("disturbance_force")

    def slope(t: float, x: np.ndarray, begin: int) -> list[float]:
        q, v, angle, w = x
        friction = (forwards if w > 0 else backwards) * w
        on_cart = force(t, begin) - K * q - VISCOUS * v + ME * w * w * math.sin(angle)
        on_arm = KM * current(t, begin) - friction
        exchange = ME * math.cos(angle)
        if arm and cart:
            determinant = M * J - exchange**2
            return [
                v,
                (J * on_cart - exchange * on_arm) / determinant,
                w,
                (M * on_arm - exchange * on_cart) / determinant,
            ]
        return [v, on_cart / M if cart else 0.0, w, on_arm / J if arm else 0.0]

    rows, state = [np.array(start)], np.array(start)
    for begin in range(0, last, pieces):
        end = min(begin + pieces, last)
        times = one.time[begin : end + 1]
        solved = solve_ivp(
            slope, (times[0], times[-1]), state, "DOP853", times, rtol=1e-12, atol=1e-15, args=(begin,), max_step=0.02
        )
        rows += list(solved.y.T[1:])
        state = solved.y[:, -1]
    return np.array(rows)


def inputs(samples: int, *, blocks: int = 1) -> dict[str, np.ndarray]:
    """Random inputs, constant over blocks of samples."""
    random = np.random.default_rng(1)
    draws = -(-samples // blocks)
    return {
        "current": np.repeat(0.2 * random.standard_normal(draws), blocks)[:samples],
        "disturbance_force": np.repeat(0.4 * random.standard_normal(draws), blocks)[:samples],
    }


# -- against another integrator ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("arm", "cart"), [("free", "free"), ("locked", "free"), ("free", "clamped")])
def test_held_inputs(arm, cart):
    one = experiment(samples=61, sample_time=0.01, arm=arm, cart=cart, **inputs(61, blocks=5))
    start = (0.008, 0.02 * (cart == "free"), 0.7, 6.0 * (arm == "free"))
    assert_close(run(SMOOTH, one, start, 32), reference(one, start, pieces=5), 1e-8)


@pytest.mark.parametrize("intersample", ["foh", "bl"])
def test_continuous_inputs(intersample):
    one = experiment(samples=41, sample_time=0.01, intersample=intersample, **inputs(41))
    expected = reference(one, START, pieces=1)
    assert_close(run(SMOOTH, one, START, 32), expected, 1e-8)
    # The same samples held are another experiment: so the test above can tell them apart.
    held = experiment(samples=41, sample_time=0.01, **inputs(41))
    assert np.max(np.abs(run(SMOOTH, held, START, 32) - expected)[:, 3]) > 0.1


def test_asymmetric_friction():
    model = RTAC(BODY, (CartViscous(VISCOUS), ArmViscous(1e-4, 3e-4)))
    push = {"current": 0.002 * inputs(61, blocks=5)["current"]}
    for turning in (25.0, -25.0):
        start = (0.008, 0.02, 0.7, turning)
        one = experiment(samples=61, sample_time=0.01, **push)
        found = run(model, one, start, 32)
        assert np.all(np.sign(found[:, 3]) == np.sign(turning))
        assert_close(found, reference(one, start, pieces=5, forwards=1e-4, backwards=3e-4), 1e-8)
    # Where the arm turns round, friction has a kink within a step.
    one = experiment(samples=61, sample_time=0.01, **inputs(61, blocks=5))
    start = (0.008, 0.02, 0.7, -6.0)
    found = run(model, one, start, 32)
    assert np.any(np.diff(np.sign(found[:, 3])) != 0)
    assert_close(found, reference(one, start, pieces=5, forwards=1e-4, backwards=3e-4), 1e-5)


def test_nondimensional_form():
    """Equation (3), with the scaling of time, position, torque and force of Bupp, Bernstein and Coppola."""
    epsilon, rate = ME / math.sqrt(J * M), math.sqrt(K / M)
    one = experiment(samples=41, sample_time=0.01, **inputs(41, blocks=10))

    def slope(tau: float, x: np.ndarray, u: float, w: float) -> np.ndarray:
        cosine, sine = math.cos(x[2]), math.sin(x[2])
        bracket = 1 - epsilon**2 * cosine**2
        swing = x[0] - epsilon * x[3] ** 2 * sine
        f = np.array([x[1], -swing / bracket, x[3], epsilon * cosine * swing / bracket])
        g = np.array([0.0, -epsilon * cosine, 0.0, 1.0]) / bracket
        d = np.array([0.0, 1.0, 0.0, -epsilon * cosine]) / bracket
        return f + g * u + d * w

    scale = np.array([math.sqrt(M / J), math.sqrt(M / J) / rate, 1.0, 1.0 / rate])
    state, rows = scale * START, [scale * START]
    for begin in range(0, 40, 10):
        u = M / (K * J) * KM * one.inputs["current"].values[begin]
        w = math.sqrt(M / J) / K * one.inputs["disturbance_force"].values[begin]
        times = rate * one.time[begin : begin + 11]
        solved = solve_ivp(
            slope, (times[0], times[-1]), state, "DOP853", times, rtol=1e-12, atol=1e-14, args=(u, w), max_step=0.2
        )
        state, rows = solved.y[:, -1], rows + list(solved.y.T[1:])
    assert_close(run(RTAC(BODY), one, START, 32), np.array(rows) / scale, 1e-8)


@pytest.mark.slow
def test_virtual_rig():
    """Another simulator with another treatment of friction: apart by less than a fiftieth of the sensors' noise."""
    plans: list[Plan] = standard_plans(seed=4, duration=5.0, free=1, forced=1, rest=0)
    rig = Rig()
    tracks = integrate([(rig, plan, np.random.SeedSequence(0)) for plan in plans], 5e-5)
    given = []
    for plan in plans:
        driven = {} if plan.current is None else {"current": plan.current}
        given.append(experiment(plan.name, samples=plan.samples, sample_time=plan.sample_time, **driven))
    start = {plan.name: (plan.initial_position, 0.0, plan.initial_angle, 0.0) for plan in plans}
    found = simulate(RTAC.paper(), given, start=start, substeps=4)
    for plan, track in zip(plans, tracks, strict=True):
        for ours, theirs, noise in (
            (found[plan.name].cart_position, track.position, rig.position_noise),
            (found[plan.name].arm_velocity, track.arm_velocity, rig.velocity_noise),
        ):
            assert np.sqrt(np.mean((ours - theirs) ** 2)) < 0.02 * noise, plan.name
            assert np.std(theirs) > 5 * noise, plan.name
    assert np.any(found["free_1"].states["cart_velocity"] != 0)


# -- order of accuracy ---------------------------------------------------------------------------------------------


def orders(errors: list[float]) -> np.ndarray:
    return np.log2(np.array(errors[:-1]) / np.array(errors[1:]))


def test_fourth_order_where_smooth():
    one = experiment(samples=41, sample_time=0.02, **inputs(41, blocks=10))
    expected = reference(one, START, pieces=10)
    errors = [float(np.max(np.abs(run(SMOOTH, one, START, n) - expected)[:, 0])) for n in (2, 4, 8)]
    assert np.all(orders(errors) > 3.7), errors
    assert np.all(orders(errors) < 4.5), errors


def coulomb_oscillator(time: np.ndarray, start: float, level: float) -> np.ndarray:
    """Position of a released mass on a spring with Coulomb friction: half cosines about +-d/k until it stays."""
    rate, band, position, begin = math.sqrt(K / M), level / K, start, 0.0
    found = np.full_like(time, np.nan)
    while abs(position) > band:
        centre = math.copysign(band, position)
        part = (time >= begin) & (time <= begin + math.pi / rate)
        found[part] = centre + (position - centre) * np.cos(rate * (time[part] - begin))
        position, begin = 2 * centre - position, begin + math.pi / rate
    found[time >= begin] = position
    return found


def test_second_order_with_dry_friction():
    model, level = RTAC(BODY, (CartCoulomb(0.2),)), 0.2
    one = experiment(samples=150, sample_time=0.02, arm="locked")
    expected = coulomb_oscillator(one.time, 0.0145, level)
    assert np.ptp(expected[-20:]) == 0, "the exact solution should come to rest"
    found = [run(model, one, (0.0145, 0, 0, 0), n) for n in (1, 2, 4, 8, 16)]
    errors = [float(np.sqrt(np.mean((states[:, 0] - expected) ** 2))) for states in found]
    assert math.log2(errors[0] / errors[-1]) / 4 > 1.7, errors
    assert errors[-1] < 5e-9, errors
    for states in found:
        assert np.ptp(states[-20:, 0]) == 0
        assert np.all(states[-20:, 1] == 0)
        assert abs(states[-1, 0]) <= level / K


@pytest.mark.parametrize("share", [-0.999, -0.3, 0.0, 0.5, 0.999])
def test_what_sticks_does_not_move(share):
    model = RTAC(BODY, (CartCoulomb(0.024), CartViscous(VISCOUS)))
    start = (share * 0.024 / K, 0.0, 0.3, 0.0)
    one = experiment(samples=200, sample_time=0.005, arm="locked")
    assert np.all(run(model, one, start, 1) == start)
    outside = (1.01 * 0.024 / K, 0.0, 0.3, 0.0)
    assert run(model, one, outside, 1)[-1, 0] < outside[0]


@pytest.mark.parametrize("share", [-0.95, 0.0, 0.95])
def test_cart_and_arm_stick_together(share):
    """The arm is held, so the motor does not reach the cart: alone, its reaction would tear the cart off."""
    model = RTAC.paper() + ArmCoulomb(1e-3)
    start = (share * 0.024 / K, 0.0, 0.1, 0.0)
    held = experiment(samples=200, sample_time=0.005, current=np.full(200, 0.9e-3 / KM))
    for substeps in (1, 4):
        np.testing.assert_allclose(run(model, held, start, substeps), np.tile(start, (200, 1)), rtol=0, atol=1e-12)
    torn = experiment(samples=200, sample_time=0.005, current=np.full(200, 1.2e-3 / KM))
    assert run(model, torn, start, 1)[-1, 2] > 0.2


# -- energy --------------------------------------------------------------------------------------------------------


def energy(states: np.ndarray, mass: float = M) -> np.ndarray:
    q, v, angle, w = states.T
    return 0.5 * mass * v**2 + 0.5 * J * w**2 + ME * v * w * np.cos(angle) + 0.5 * K * q**2


def test_energy_is_conserved():
    one = experiment(samples=1001, sample_time=0.01)
    found = energy(run(RTAC(BODY), one, (0.01, 0.0, 0.5, 15.0), 20))
    assert np.ptp(found) < 1e-9 * found[0]


def test_energy_lost_is_friction_times_velocity():
    one = experiment(samples=2001, sample_time=0.001)
    states = run(SMOOTH, one, (0.01, 0.0, 0.5, 15.0), 2)
    power = VISCOUS * states[:, 1] ** 2 + KV * states[:, 3] ** 2
    lost = cumulative_simpson(power, x=one.time, initial=0)
    found = energy(states)
    np.testing.assert_allclose(found[0] - found, lost, rtol=0, atol=1e-6 * found[0])
    assert lost[-1] > 0.5 * found[0]


@pytest.mark.parametrize("damping", [0.0, 0.05])
def test_flexible_mode_stores_and_loses_energy(damping):
    mass, frequency = 0.2, 37.4
    model = RTAC(BODY, (FlexibleMode(mass, frequency, damping),))
    one = experiment(samples=501, sample_time=0.01)
    start = (0.01, 0.0, 0.5, 15.0, 0.002, 0.1)
    found = simulate(model, [one], start={"a": start}, substeps=20)["a"].states
    rigid = np.stack([found[name] for name in RIGID], axis=1)
    stretch, speed = found["flexible_mode.displacement"], found["flexible_mode.velocity"]
    total = energy(rigid, M - mass) + 0.5 * mass * (speed**2 + (frequency * stretch) ** 2)
    if damping:
        assert np.all(np.diff(total) < 1e-9 * total[0])
        assert total[-1] < 0.95 * total[0]
    else:
        assert np.ptp(total) < 1e-7 * total[0]
        assert np.ptp(energy(rigid)) > 1e-2 * total[0]


# -- consistency ---------------------------------------------------------------------------------------------------


def test_any_sample_is_a_start():
    model = RTAC.paper() + FlexibleMode(0.1, 37.4, 0.02)
    whole = experiment(samples=300, sample_time=0.005, **inputs(300))
    found = simulate(model, [whole], start={"a": START}, substeps=2)["a"].states
    table = np.stack(list(found.values()), axis=1)
    again = simulate(model, [whole.cut(120, 300, "b")], start={"b": table[120]}, substeps=2)["b"].states
    assert_close(np.stack(list(again.values()), axis=1), table[120:], 1e-12)


def test_a_simulation_prints_no_samples():
    (one,) = simulate(RTAC.paper(), [experiment(samples=300, sample_time=0.005)], start={"a": START}).values()
    assert repr(one).startswith("Simulation(300 samples, 1.495 s, states cart_position")
    assert len(repr(one)) < 200


def test_experiments_together_equal_experiments_alone():
    push = {"disturbance_force": inputs(120)["disturbance_force"]}
    given = [
        experiment("long", samples=300, sample_time=0.005, **inputs(300)),
        experiment("short", samples=90, sample_time=0.008, current=inputs(90)["current"], intersample="bl"),
        experiment("pushed", samples=120, sample_time=0.01, intersample="foh", **push),
        experiment("locked", samples=50, sample_time=0.005, arm="locked", initial_arm_angle=0.4),
        experiment("clamped", samples=60, sample_time=0.005, cart="clamped", current=inputs(60)["current"]),
    ]
    start = {"long": START, "short": (0.0, 0.1, -2.0, 3.0), "locked": (0.01, 0, 0.4, 0)}
    together = simulate(RTAC.paper(), given, start=start, substeps=3)
    assert list(together) == [one.name for one in given]
    for one in given:
        alone = simulate(RTAC.paper(), [one], start=start, substeps=3)[one.name]
        np.testing.assert_array_equal(together[one.name].time, one.time)
        for name in ("cart_position", "arm_velocity", "arm_angle"):
            values = getattr(together[one.name], name)
            assert values.shape == (one.samples,)
            np.testing.assert_allclose(values, getattr(alone, name), rtol=1e-11, atol=1e-13)
    assert np.all(together["locked"].arm_angle == 0.4)
    assert np.all(together["clamped"].cart_position == 0)


@pytest.mark.parametrize(("room", "batched", "loops"), [(64, False, True), (UNROLLED, False, False), (64, True, False)])
def test_stages_are_a_loop_where_samples_are_few_and_nothing_is_batched(room: int, batched: bool, loops: bool) -> None:
    excitation = Excitation.of([experiment(samples=64, sample_time=0.01)])
    start = jnp.array(START)[:, None]

    def states(start: Any) -> Any:
        if batched:
            return differentiable_states(SMOOTH, start, excitation, 64, jnp.asarray(64), jnp.asarray(1), 1)
        return trajectories(SMOOTH, tuple(start), excitation, room=room, samples=jnp.asarray(64), substeps=1)

    assert ("scan[" in str(jax.make_jaxpr(states)(start))) == loops
