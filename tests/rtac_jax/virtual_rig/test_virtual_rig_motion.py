"""The motion of the virtual rig against theory and against another integrator."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import eigh

from rtac_jax.virtual_rig import Plan, Rig, record
from rtac_jax.virtual_rig._motion import Track, integrate

SEED = np.random.SeedSequence(0)


def move(rig: Rig, plan: Plan, step: float = 2e-4) -> Track:
    return integrate([(rig, plan, SEED)], step)[0]


def forced_plan(duration: float = 2.0, **changes) -> Plan:
    random = np.random.default_rng(3)
    samples = round(duration / 0.01)
    current = 0.3 * np.repeat(random.standard_normal(samples // 10), 10)
    return Plan(
        "forced",
        "forced",
        duration,
        0.01,
        **{
            "current": current,
            "disturbance_force": 0.2 * random.standard_normal(samples),
            "initial_position": 0.01,
            "initial_velocity": 0.02,
            "initial_angle": 0.7,
            "initial_arm_velocity": 1.0,
            **changes,
        },
    )


def reference(rig: Rig, plan: Plan) -> np.ndarray:
    """(N, 10) states by DOP853, from equations (1)-(2) with the smooth effects, without dry friction.

    They are q, theta, q', theta', place and speed of the flexible part, Maxwell's inner point, Bouc-Wen's z, and
    Dahl's of cart and arm.
    """
    me, body, g = rig.eccentric_moment, rig.flexible_mass, 9.81
    viscous = rig.arm_viscous_positive
    assert rig.arm_viscous_negative == viscous

    def slope(t, y, i, f):
        q, theta, speed, arm_speed, place, body_speed, inner, z, *bristles = y
        coupling = me * np.cos(theta)
        pull = rig.flexible_frequency**2 * (q - place)
        pull += 2 * rig.flexible_damping * rig.flexible_frequency * (speed - body_speed)
        cart = me * arm_speed**2 * np.sin(theta) - rig.spring_stiffness * q - rig.cart_viscous * speed + f
        cart -= rig.cubic_spring * q**3 + rig.quadratic_spring * q**2 + body * pull
        cart -= rig.cart_asymmetry * abs(speed)
        cart -= rig.cart_quadratic_drag * abs(speed) * speed + rig.maxwell_stiffness * (q - inner)
        cart -= rig.hysteresis_stiffness * z + rig.one_sided_spring * max(q, 0.0)
        cart -= rig.cart_presliding * bristles[0] / rig.cart_presliding_yield
        cart += rig.total_mass * g * np.sin(rig.tilt_along)
        away = (q - rig.detent_position) / rig.detent_width
        cart -= rig.detent_force * away * np.exp(0.5 - 0.5 * away**2)
        cart += rig.vibration_force * np.sin(2 * np.pi * rig.vibration_frequency * t + rig.vibration_phase)
        arm = rig.torque_constant * i - viscous * arm_speed
        arm -= rig.arm_quadratic_drag * abs(arm_speed) * arm_speed
        arm += rig.cogging_torque * np.sin(rig.cogging_order * theta + rig.cogging_phase)
        arm += rig.second_cogging_torque * np.sin(rig.second_cogging_order * theta + rig.second_cogging_phase)
        ripple = rig.torque_ripple * np.sin(rig.torque_ripple_order * theta + rig.torque_ripple_phase)
        arm += rig.torque_constant * i * ripple
        arm -= rig.arm_presliding * bristles[1] / rig.arm_presliding_yield
        arm -= rig.cable_stiffness * (theta - rig.cable_home)
        arm += me * g * (np.sin(rig.tilt_along) * np.cos(theta) - np.sin(rig.tilt_across) * np.sin(theta))
        mass = np.array([[rig.total_mass - body, coupling], [coupling, rig.arm_inertia]])
        creep = rig.maxwell_stiffness / rig.maxwell_damping * (q - inner)
        turn = speed - (abs(speed) * z + speed * abs(z)) / (2 * rig.hysteresis_yield)
        yields = (rig.cart_presliding_yield, rig.arm_presliding_yield)
        bends = [v - abs(v) * b / w for v, b, w in zip((speed, arm_speed), bristles, yields, strict=True)]
        return [speed, arm_speed, *np.linalg.solve(mass, [cart, arm]), body_speed, pull, creep, turn, *bends]

    current = np.zeros(plan.samples) if plan.current is None else plan.current
    force = np.zeros(plan.samples) if plan.disturbance_force is None else plan.disturbance_force
    q, speed = plan.initial_position, plan.initial_velocity
    states = [np.array([q, plan.initial_angle, speed, plan.initial_arm_velocity, q, speed, q, 0.0, 0.0, 0.0])]
    for n in range(plan.samples - 1):
        span = (n * plan.sample_time, (n + 1) * plan.sample_time)
        found = solve_ivp(slope, span, states[-1], "DOP853", args=(current[n], force[n]), rtol=1e-10, atol=1e-13)
        states.append(found.y[:, -1])
    return np.array(states)


def test_forced_motion_agrees_with_another_integrator_to_second_order():
    rig = Rig(cart_coulomb=0.0, arm_viscous_negative=Rig.arm_viscous_positive)
    plan = forced_plan()
    truth = reference(rig, plan)[:, :4]
    errors = []
    for step in (4e-4, 2e-4, 5e-5):
        track = move(rig, plan, step)
        states = np.stack([track.position, track.angle, track.velocity, track.arm_velocity], axis=1)
        errors.append(np.abs(states - truth).max(axis=0) / np.abs(truth).max(axis=0))
    assert np.all(errors[-1] < 1e-6)
    np.testing.assert_allclose(np.log2(errors[0] / errors[1]), 2.0, atol=0.2)
    np.testing.assert_allclose(np.log2(errors[1] / errors[2]), 4.0, atol=0.4)


SMOOTH = {
    "springs": {"cubic_spring": 2e5, "quadratic_spring": 900.0},
    "flexible": {"flexible_mass": 0.25, "flexible_damping": 0.05},
    "asymmetric friction": {"cart_asymmetry": 0.4},
    "drag": {"cart_quadratic_drag": 3.0, "arm_quadratic_drag": 6e-6},
    "tilt": {"tilt_along": 0.01, "tilt_across": 0.03},
    "second cogging": {"cogging_torque": 1e-3, "second_cogging_torque": 2e-3, "second_cogging_phase": 0.4},
    "torque_ripple": {"torque_ripple": 0.2, "torque_ripple_phase": 0.4},
    "arm": {"cogging_torque": 2e-3, "cogging_phase": 0.4, "cable_stiffness": 1e-3, "cable_home": 0.5},
    "detent": {"detent_force": 0.2},
    "one side": {"one_sided_spring": 60.0},
    "vibration": {"vibration_force": 0.2, "vibration_phase": 1.0},
    "maxwell": {"maxwell_stiffness": 30.0, "maxwell_damping": 4.0},
    "hysteresis": {"hysteresis_stiffness": 30.0},
    "bristles": {
        "cart_presliding": 0.03,
        "cart_presliding_yield": 2e-3,
        "arm_presliding": 5e-4,
        "arm_presliding_yield": 0.5,
    },
}


@pytest.mark.parametrize("name", SMOOTH)
def test_smooth_effects_agree_with_another_integrator_to_second_order(name):
    rig = Rig(cart_coulomb=0.0, arm_viscous_negative=Rig.arm_viscous_positive, **SMOOTH[name])
    plan = forced_plan(0.5)
    truth = reference(rig, plan)
    largest = []
    for step in (4e-4, 1e-4):
        track = move(rig, plan, step)
        states = np.stack([track.position, track.angle], axis=1)
        largest.append((np.abs(states - truth[:, :2]).max(axis=0) / np.abs(truth[:, :2]).max(axis=0)).max())
    assert largest[1] < 1e-5
    assert largest[0] / largest[1] > 12


def test_equal_halves_of_asymmetric_friction_are_continuous():
    plan = forced_plan()
    one = move(Rig(arm_viscous_negative=Rig.arm_viscous_positive), plan)
    other = move(Rig(arm_viscous_negative=Rig.arm_viscous_positive * (1 + 1e-9)), plan)
    np.testing.assert_allclose(other.arm_velocity, one.arm_velocity, atol=1e-6)


def test_arm_velocity_decays_at_the_rate_of_its_direction():
    rig = Rig(eccentric_moment=1e-9)
    for sign, viscous in ((1, rig.arm_viscous_positive), (-1, rig.arm_viscous_negative)):
        track = move(rig, Plan("spin", "free", 2.0, 0.01, initial_arm_velocity=20.0 * sign))
        expected = 20 * sign * np.exp(-viscous / rig.arm_inertia * 0.01 * np.arange(200))
        np.testing.assert_allclose(track.arm_velocity, expected, rtol=1e-6)


@pytest.mark.slow
def test_energy_is_conserved_without_damping():
    tilt = {"tilt_along": 0.02, "tilt_across": -0.03}
    rig = Rig(
        cart_viscous=0,
        cart_coulomb=0,
        arm_viscous_positive=0,
        arm_viscous_negative=0,
        cubic_spring=2e4,
        **tilt,
    )
    track = move(rig, Plan("spin", "free", 10.0, 0.005, initial_position=0.012, initial_arm_velocity=12.0))
    m, me, g = rig.total_mass, rig.eccentric_moment, 9.81
    gx, gy = g * np.sin(0.02), g * np.sin(-0.03)
    q, theta, speed, arm = track.position, track.angle, track.velocity, track.arm_velocity
    energy = 0.5 * m * speed**2 + 0.5 * rig.arm_inertia * arm**2 + me * np.cos(theta) * speed * arm
    energy += 0.5 * rig.spring_stiffness * q**2 + 0.25 * 2e4 * q**4
    energy -= m * gx * q + me * gx * np.sin(theta) + me * gy * np.cos(theta)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-5)


def test_dry_friction_takes_the_same_from_each_half_swing_and_ends_at_rest():
    rig = Rig(cart_viscous=0.0)
    band = rig.cart_coulomb / rig.spring_stiffness
    omega = np.sqrt(rig.spring_stiffness / rig.total_mass)
    time = 0.005 * np.arange(1900)
    exact, amplitude, half_swing = np.empty(1900), 0.01, 0
    while amplitude > band:
        rows = time * omega >= np.pi * half_swing
        swing = (amplitude - band) * np.cos(omega * time[rows] - np.pi * half_swing) + band
        exact[rows] = (-1) ** half_swing * swing
        amplitude, half_swing = amplitude - 2 * band, half_swing + 1
    exact[time * omega >= np.pi * half_swing] = (-1) ** half_swing * amplitude
    errors = []
    for step in (4e-4, 1e-4):
        track = move(rig, Plan("decay", "free", 9.5, 0.005, initial_position=0.01, arm="locked"), step)
        errors.append(np.abs(track.position - exact).max())
        assert np.all(track.velocity[-100:] == 0.0)
        assert np.all(track.position[-100:] == track.position[-1])
        assert abs(track.position[-1]) <= band
    assert errors[1] < 2e-8
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.3)


@pytest.mark.slow
def test_free_decay_with_a_free_arm_ends_at_rest_inside_the_band():
    rig = Rig(arm_coulomb=1e-4)
    track = move(rig, Plan("decay", "free", 10.0, 0.01, initial_position=0.008, initial_angle=0.4))
    assert np.all(track.velocity[-50:] == 0.0)
    assert np.all(track.arm_velocity[-50:] == 0.0)
    assert abs(track.position[-1]) <= rig.cart_coulomb / rig.spring_stiffness


def test_cart_inside_the_band_does_not_move():
    rig = Rig()
    place = 0.95 * rig.cart_coulomb / rig.spring_stiffness
    track = move(rig, Plan("stuck", "free", 2.0, 0.01, initial_position=place, initial_angle=1.0))
    assert np.all(track.position == place)
    np.testing.assert_allclose(track.angle, 1.0, atol=1e-12)
    freed = move(rig, Plan("free", "free", 2.0, 0.01, initial_position=1.2 * place, initial_angle=1.0))
    assert np.abs(np.diff(freed.position)).max() > 0


def test_arm_is_held_by_dry_friction_until_the_torque_exceeds_it():
    rig = Rig(arm_coulomb=2e-3)
    for share in (0.9, 1.1):
        current = np.full(100, share * rig.arm_coulomb / rig.torque_constant)
        track = move(rig, Plan("push", "forced", 1.0, 0.01, current, initial_angle=np.pi / 2))
        assert np.all(track.angle == np.pi / 2) == (share < 1)


def test_locked_arm_and_clamped_cart():
    rig = Rig(cart_coulomb=0.0, cart_viscous=0.0)
    locked = move(
        rig, forced_plan(arm="locked", initial_arm_velocity=0.0, disturbance_force=None, initial_velocity=0.0)
    )
    omega = np.sqrt(rig.spring_stiffness / rig.total_mass)
    np.testing.assert_allclose(locked.position, 0.01 * np.cos(omega * 0.01 * np.arange(200)), atol=1e-7)
    assert np.all(locked.angle == 0.7)
    clamped = move(rig, forced_plan(cart="clamped", initial_velocity=0.0))
    assert np.all(clamped.position == 0.01)
    assert np.ptp(clamped.angle) > 1.0


@pytest.mark.slow
def test_flexible_mode_has_the_frequencies_of_the_eigenvalue_problem():
    rig = Rig(cart_coulomb=0, cart_viscous=0, flexible_mass=0.3, flexible_frequency=37.4, flexible_damping=0.0)
    track = move(rig, Plan("ring", "free", 20.0, 0.01, initial_position=0.01, arm="locked"))
    stiffness = rig.flexible_mass * rig.flexible_frequency**2
    matrix = np.array([[rig.spring_stiffness + stiffness, -stiffness], [-stiffness, stiffness]])
    masses = np.diag([rig.total_mass - rig.flexible_mass, rig.flexible_mass])
    expected = np.sqrt(eigh(matrix, masses, eigvals_only=True))
    # From rest relative to the cart the motion is a sum of two cosines: their frequencies, by least squares.
    time = 0.01 * np.arange(track.position.size)
    modes = np.cos(np.outer(time, expected))
    parts = np.linalg.lstsq(modes, track.position, rcond=None)[0]
    assert np.abs(modes @ parts - track.position).max() < 1e-6
    assert abs(parts[1]) > 2e-5
    assert parts.sum() == pytest.approx(0.01, rel=1e-3)


def test_end_stop_keeps_the_cart_in():
    track = move(Rig(end_stop_travel=0.008), Plan("hit", "free", 3.0, 0.005, initial_velocity=0.15))
    assert 0.008 < np.abs(track.position).max() < 0.0095


def test_current_lag_and_delay_on_a_clamped_cart():
    rig = Rig(arm_viscous_positive=0.0, arm_viscous_negative=0.0)
    plan = Plan("step", "forced", 0.5, 0.01, np.full(50, 0.1), cart="clamped")
    time, push = 0.01 * np.arange(50), 0.1 * rig.torque_constant / rig.arm_inertia
    late = move(replace(rig, input_delay=0.0123), plan)
    np.testing.assert_allclose(late.arm_velocity, push * np.maximum(time - 0.0123, 0), atol=1e-9)
    slow = move(replace(rig, current_lag=0.02), plan)
    np.testing.assert_allclose(slow.arm_velocity, push * (time - 0.02 * (1 - np.exp(-time / 0.02))), atol=1e-9)
    limited = move(replace(rig, saturation=0.05), plan)
    np.testing.assert_allclose(limited.arm_velocity, 0.5 * push * time, atol=1e-9)
    dead = move(replace(rig, dead_zone=0.04, current_offset=-0.01), plan)
    np.testing.assert_allclose(dead.arm_velocity, 0.5 * push * time, atol=1e-9)


def test_a_force_comes_late_and_not_whole():
    rig = Rig(cart_viscous=0.0, cart_coulomb=0.0, spring_stiffness=1e-9)
    time, push = 0.01 * np.arange(50), 0.1 / rig.total_mass
    force = np.full(50, 0.1)
    plan = Plan("step", "forced", 0.5, 0.01, disturbance_force=force, arm="locked")
    late = move(replace(rig, force_delay=0.0123), plan)  # before the record it was what it is first
    np.testing.assert_allclose(late.position, 0.5 * push * time**2, atol=1e-9)
    limited = move(replace(rig, force_saturation=0.05), plan)
    np.testing.assert_allclose(limited.position, 0.25 * push * time**2, atol=1e-9)
    dead = move(replace(rig, force_dead_zone=0.04, force_saturation=0.09), plan)
    np.testing.assert_allclose(dead.position, 0.25 * push * time**2, atol=1e-9)
    short = move(replace(rig, force_droop=10.0), plan)
    np.testing.assert_allclose(short.position, 0.25 * push * time**2, atol=1e-9)
    force[:10] = 0.0
    slow, since = (
        move(replace(rig, force_lag=0.02), replace(plan, disturbance_force=force)),
        np.maximum(time - 0.1, 0.0),
    )
    late = move(replace(rig, force_delay=0.0123), replace(plan, disturbance_force=force))
    np.testing.assert_allclose(late.position, 0.5 * push * np.maximum(time - 0.1123, 0) ** 2, atol=1e-7)
    behind = 0.5 * since**2 - 0.02 * since + 0.02**2 * (1 - np.exp(-since / 0.02))
    np.testing.assert_allclose(slow.position, push * behind, atol=1e-7)


def test_sensor_lag_follows_a_ramp_late():
    rig = Rig(arm_viscous_positive=0.0, arm_viscous_negative=0.0, tacho_lag=0.03)
    track = move(rig, Plan("step", "forced", 1.0, 0.01, np.full(100, 0.1), cart="clamped"))
    time, push = 0.01 * np.arange(100), 0.1 * rig.torque_constant / rig.arm_inertia
    expected = push * (time - 0.03 * (1 - np.exp(-time / 0.03)))
    np.testing.assert_allclose(track.seen_arm_velocity, expected, atol=1e-5)
    assert np.all(track.seen_position == track.position)


def test_random_torque_has_the_stated_spectral_density():
    rig = Rig(torque_noise=1e-4, eccentric_moment=1e-9, arm_viscous_positive=0, arm_viscous_negative=0)
    plan = Plan("shake", "free", 1.0, 0.01, arm="free", cart="clamped")
    jobs = [(rig, plan, seed) for seed in np.random.SeedSequence(5).spawn(400)]
    ends = [track.arm_velocity[-1] for track in integrate(jobs, 1e-3)]
    assert np.std(ends) == pytest.approx(1e-4 * np.sqrt(0.99) / rig.arm_inertia, rel=0.12)
    coarse, fine = move(rig, plan, 1e-3), move(rig, plan, 2e-4)
    np.testing.assert_allclose(coarse.arm_velocity, fine.arm_velocity, atol=1e-9)


def test_rotor_and_arm_share_what_one_of_them_gets():
    """Without friction the motor gives both together the same momentum, whether they are one or not."""
    rig = Rig(arm_viscous_positive=0.0, arm_viscous_negative=0.0)
    time = 0.01 * np.arange(100)
    plan = Plan("push", "forced", 1.0, 0.01, 0.1 * np.sin(8 * time), cart="clamped")
    whole = move(rig, plan)
    for apart in ({"backlash": 0.05}, {"shaft_stiffness": 0.3, "shaft_damping": 1e-4}):
        track = move(replace(rig, **apart), plan)
        together = rig.rotor_share * track.seen_arm_velocity + (1 - rig.rotor_share) * track.arm_velocity
        np.testing.assert_allclose(together, whole.arm_velocity, atol=1e-9)
        twist = track.seen_angle - track.angle
        assert np.ptp(twist) > 1e-3
        if "backlash" in apart:
            assert 0.95 * 0.025 < np.abs(twist).max() < 1.02 * 0.025


@pytest.mark.slow
def test_shaft_rings_at_its_frequency():
    stiffness, rig = 0.5, Rig(arm_viscous_positive=0.0, arm_viscous_negative=0.0, rotor_share=0.4)
    plan = Plan("push", "forced", 0.5, 1e-3, np.full(500, 0.1), cart="clamped")
    track = move(replace(rig, shaft_stiffness=stiffness), plan, 2e-5)
    reduced = 0.4 * 0.6 * rig.arm_inertia
    rest = 0.1 * rig.torque_constant * 0.6 / stiffness
    expected = rest * (1 - np.cos(np.sqrt(stiffness / reduced) * 1e-3 * np.arange(500)))
    np.testing.assert_allclose(track.seen_angle - track.angle, expected, atol=2e-3 * rest)


@pytest.mark.parametrize("played", [pytest.param("foh", marks=pytest.mark.slow), "bl"])
def test_inputs_that_run_otherwise_than_the_recording_says(played):
    rig = Rig(arm_viscous_positive=0.0, arm_viscous_negative=0.0)
    time = 0.01 * np.arange(200)
    plan = Plan("play", "forced", 2.0, 0.01, 0.2 * np.sin(12 * time), cart="clamped", played=played)
    found = move(rig, plan).arm_velocity
    push = 0.2 * rig.torque_constant / rig.arm_inertia
    exact = push * (1 - np.cos(12 * time)) / 12
    straight = push * np.append(0.0, np.cumsum(0.005 * (np.sin(12 * time[1:]) + np.sin(12 * time[:-1]))))
    # What comes after the last sample the smooth curve cannot know.
    expected = (exact if played == "bl" else straight)[:-2]
    np.testing.assert_allclose(found[:-2], expected, atol=1e-5 * push / 12)
    held = move(rig, replace(plan, played=None)).arm_velocity
    assert np.abs(found - held).max() > 0.01 * push / 12
    recorded = record(rig, [plan], seed=0)["play"].inputs["current"]
    assert recorded.intersample == "zoh"
    right = record(rig, [replace(plan, intersample=played)], seed=0)["play"]
    assert right.inputs["current"].intersample == played


def test_eddy_brake_has_its_peak():
    rig = Rig(eddy_torque=2e-3, eddy_velocity=4.0, arm_viscous_positive=0.0, arm_viscous_negative=0.0)
    track = move(rig, Plan("brake", "free", 1.0, 1e-3, initial_arm_velocity=12.0, cart="clamped"))
    braking = -np.gradient(track.arm_velocity, 1e-3) * rig.arm_inertia
    assert braking[2:-2].max() == pytest.approx(2e-3, rel=1e-3)
    assert track.arm_velocity[np.argmax(braking)] == pytest.approx(4.0, rel=0.02)
