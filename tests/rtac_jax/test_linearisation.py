"""Linear models against equation (4), against plain NumPy, and against small motions of the nonlinear model."""

import control as ct
import numpy as np
import pytest

from rtac_jax import RTAC, Experiment, RigidBody, equation_4, linearise, simulate
from rtac_jax.control import Actuation, Units, nominal_plant
from rtac_jax.effects import ArmViscous, CartViscous, FlexibleMode, GravityTilt, InputDelay
from rtac_jax.linearisation import linear_matrices

M, J, ME, K, KM = 1.23, 9.5e-5, 1.06e-3, 132.6, 8.04e-2
VISCOUS = 0.5543
BODY = RigidBody(M, J, ME, K, KM)
OMEGA = np.geomspace(0.1, 300.0, 200)


def numpy_plant(angle: float, arm_friction: float, *, stiffness: float = 0.0) -> np.ndarray:
    """Cart position by torque over OMEGA, from equations (1) and (2) at small motions, in SI units."""
    s, coupling = 1j * OMEGA, ME * np.cos(angle)
    cart = M * s**2 + VISCOUS * s + K
    arm = J * s**2 + arm_friction * s + stiffness
    return -coupling * s**2 / (cart * arm - (coupling * s**2) ** 2)


@pytest.mark.parametrize("angle", [0.0, 0.7, -1.3])
def test_equation_4(angle):
    model = RTAC(BODY, (CartViscous(VISCOUS),))
    rate, units = np.sqrt(K / M), Units.nondimensional(model)
    exact = linearise(model, arm_angle=angle)[0, 0](1j * OMEGA) * units.position / units.torque
    np.testing.assert_allclose(equation_4(model, arm_angle=angle, rate=rate)(1j * OMEGA), exact, rtol=1e-9)
    np.testing.assert_allclose(
        equation_4(model, arm_angle=angle)(1j * OMEGA / rate), equation_4(model, arm_angle=angle, rate=rate)(1j * OMEGA)
    )
    # As printed, with epsilon and v / sqrt(k (M+m)).
    epsilon, p = ME / np.sqrt(J * M) * np.cos(angle), 1j * OMEGA
    printed = epsilon / ((epsilon**2 - 1) * p**2 - VISCOUS / np.sqrt(K * M) * p - 1)
    np.testing.assert_allclose(equation_4(model, arm_angle=angle)(p), printed, rtol=1e-12)


def test_arm_friction_is_the_mean_of_both_directions():
    plant = linearise(RTAC(BODY, (CartViscous(VISCOUS), ArmViscous(1e-4, 3e-4))))[0, 0]
    np.testing.assert_allclose(plant(1j * OMEGA), numpy_plant(0.0, 2e-4), rtol=1e-9)
    assert np.max(np.abs(plant(1j * OMEGA) / numpy_plant(0.0, 1e-4) - 1)) > 0.1


def test_current_and_disturbance():
    model = RTAC(BODY, (CartViscous(VISCOUS), ArmViscous(2e-4, 2e-4)))
    by_torque, by_current = linearise(model), linearise(model, drive="current")
    assert by_torque.input_labels == ["torque", "disturbance_force"]
    assert by_current.input_labels == ["current", "disturbance_force"]
    assert by_current.output_labels == ["cart_position", "arm_velocity", "arm_angle"]
    s = 1j * OMEGA
    np.testing.assert_allclose(by_current(s)[:, 0], KM * by_torque(s)[:, 0], rtol=1e-9)
    np.testing.assert_allclose(by_current(s)[:, 1], by_torque(s)[:, 1], rtol=1e-9)
    np.testing.assert_allclose(by_torque(s)[1], s * by_torque(s)[2], rtol=1e-7)
    static = by_torque[0, 1](1e-3j)
    np.testing.assert_allclose(static, 1 / K, rtol=1e-4)


def test_flexible_mode_adds_its_peak():
    mass, frequency, damping = 0.15, 35.0, 0.05
    model = RTAC(BODY, (CartViscous(VISCOUS), ArmViscous(2e-4, 2e-4), FlexibleMode(mass, frequency, damping)))
    found = linearise(model)
    assert found.nstates == 6
    # Cart and part as two masses, in NumPy; the arm follows its own equation.
    spring, damper, s = mass * frequency**2, 2 * damping * frequency * mass, 1j * OMEGA
    expected = np.empty(len(s), dtype=complex)
    for i, p in enumerate(s):
        link = spring + damper * p
        stiffness = np.array(
            [
                [(M - mass) * p**2 + VISCOUS * p + K + link, -link, ME * p**2],
                [-link, mass * p**2 + link, 0.0],
                [ME * p**2, 0.0, J * p**2 + 2e-4 * p],
            ]
        )
        expected[i] = np.linalg.solve(stiffness, np.array([0.0, 0.0, 1.0]))[0]
    np.testing.assert_allclose(found[0, 0](s), expected, rtol=1e-7)


def test_small_motions_follow_it():
    model = RTAC(BODY, (CartViscous(VISCOUS), ArmViscous(2e-4, 2e-4)))
    linear, time = linearise(model, arm_angle=0.6, drive="current")[:, 0], 0.002 * np.arange(1000)

    def error(size: float) -> np.ndarray:
        current = size * np.sin(9.0 * time)
        one = Experiment.of(
            "a", kind="forced", sample_time=0.002, current=current, cart_position=time, initial_arm_angle=0.6,
            intersample="foh",
        )  # fmt: skip
        moved = simulate(model, [one])["a"]
        found = np.stack([moved.cart_position, moved.arm_velocity, moved.arm_angle - 0.6])
        expected = np.asarray(ct.forced_response(linear, time, current).outputs).reshape(3, -1)
        return np.max(np.abs(found - expected), axis=1) / np.max(np.abs(expected), axis=1)

    assert np.all(error(1e-5) < 1e-3)
    assert np.all(error(1e-4)[:2] > 5 * error(1e-5)[:2])  # so it is the nonlinear terms that are left


@pytest.mark.parametrize("dead_time", [1e-3, 0.03])
def test_a_dead_time_of_the_current_turns_its_phase_and_not_the_disturbance(dead_time):
    friction = (CartViscous(VISCOUS), ArmViscous(2e-4, 2e-4))
    late = linearise(RTAC(BODY, (*friction, InputDelay(dead_time))))
    omega = OMEGA[2.5 / dead_time > OMEGA]
    s = 1j * omega
    turned = numpy_plant(0.0, 2e-4)[: len(omega)] * np.exp(-s * dead_time)
    np.testing.assert_allclose(late[0, 0](s), turned, rtol=0.01)
    within = omega < 1.0 / dead_time
    np.testing.assert_allclose(late[0, 0](s[within]), turned[within], rtol=2e-5)
    plain = linearise(RTAC(BODY, friction))
    np.testing.assert_allclose(late(s)[:, 1], plain(s)[:, 1], rtol=1e-9)
    assert late.nstates == plain.nstates + 3
    without = linearise(RTAC(BODY, (*friction, InputDelay(dead_time))), delay_order=0)
    np.testing.assert_allclose(np.array(without.A), np.array(plain.A))
    nominal = nominal_plant(RTAC(BODY, (*friction, InputDelay(dead_time))), units=Units.si())
    np.testing.assert_allclose(nominal(s[within]), turned[within], rtol=2e-5)


def test_tilted_rig_is_linearised_about_its_equilibrium():
    along, across, angle, gravity = 0.02, 0.03, 0.7, 9.80665
    tilted = RTAC(BODY, (CartViscous(VISCOUS), ArmViscous(2e-4, 2e-4), GravityTilt(along, across)))
    row = np.array(linearise(tilted, arm_angle=angle).A)[3]
    slope = -ME * gravity * (along * np.sin(angle) + across * np.cos(angle))
    np.testing.assert_allclose(row[2], M * slope / (M * J - (ME * np.cos(angle)) ** 2), rtol=1e-7)
    flat = linearise(RTAC(BODY, (CartViscous(VISCOUS), ArmViscous(2e-4, 2e-4))), arm_angle=angle)
    np.testing.assert_allclose(row[[0, 1, 3]], np.array(flat.A)[3, [0, 1, 3]], rtol=1e-9)


def test_nominal_plant_is_minimal_and_scaled():
    model = RTAC(BODY, (CartViscous(VISCOUS), ArmViscous(2e-4, 2e-4)))
    units = Units.nondimensional(model)
    np.testing.assert_allclose([units.position, units.torque], [np.sqrt(M / J), M / (K * J)])
    plain = nominal_plant(model)
    assert plain.nstates == 3
    scale = units.position / units.torque
    np.testing.assert_allclose(plain(1j * OMEGA), scale * numpy_plant(0.0, 2e-4), rtol=1e-9)
    np.testing.assert_allclose(nominal_plant(model, units=Units.si())(1j * OMEGA), numpy_plant(0.0, 2e-4), rtol=1e-9)
    sprung = nominal_plant(model, actuation=Actuation(arm_stiffness=1e-3))
    assert sprung.nstates == 4
    np.testing.assert_allclose(sprung(1j * OMEGA), scale * numpy_plant(0.0, 2e-4, stiffness=1e-3), rtol=1e-9)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m: linearise(m, arm_angle=np.nan), "finite angle"),
        (lambda m: linearise(m.with_values({"total_mass": np.ones(3)})), "one plant at a time"),
        (lambda m: linearise(m, delay_order=-1), "whole number from 0"),
        (lambda m: equation_4(m, rate=0.0), "positive rate"),
        (lambda m: Units(0.0, 1.0), "position is 0.0"),
        (lambda m: Units.nondimensional(m.with_values({"total_mass": np.ones(3)})), "differ in their scales"),
    ],
)
def test_bad_input(call, message):
    with pytest.raises(ValueError, match=message):
        call(RTAC(BODY, (CartViscous(VISCOUS),)))


def test_many_plants_at_once_are_what_each_is_alone():
    model = RTAC(BODY, (CartViscous(VISCOUS), ArmViscous(1e-4, 3e-4), FlexibleMode(0.15, 35.0, 0.05)))
    values = {"total_mass": np.array([1.1, 1.23, 1.4]), "arm_viscous.positive": np.array([1e-4, 2e-4, 5e-4])}
    together = linear_matrices(model, values)
    for i in range(3):
        alone = linearise(model.with_values({name: one[i] for name, one in values.items()}), drive="current")
        for several, one in zip(together, (alone.A, alone.B, alone.C), strict=True):
            np.testing.assert_allclose(several[i], np.asarray(one), rtol=1e-12, atol=1e-12)


def test_a_slide_has_no_normalised_time_or_torque() -> None:
    slide = RTAC.paper().with_values({"spring_stiffness": 0.0})
    for scaled in (equation_4, Units.nondimensional):
        with pytest.raises(ValueError, match="no spring"):
            scaled(slide)
