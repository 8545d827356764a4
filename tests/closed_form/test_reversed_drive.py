"""A motor that turns against its current is told by the closed form, as no other estimator has a sign for it."""

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac

INERTIA, VISCOUS, TORQUE_CONSTANT, STEP = 1.0, 8.0, 4.0, 0.005  # kg m^2, N m s/rad, N m/A, s


def run(name: str, sign: float, seed: int) -> rtac.Experiment:
    """Four seconds of a motor on held currents, exact between samples."""
    random = np.random.default_rng(seed)
    current = np.repeat(random.uniform(-6.0, 6.0, 20), 40)
    speed, angle, angles = 0.0, 0.0, []
    fading = np.exp(-VISCOUS / INERTIA * STEP)
    for one in current:
        angles.append(angle)
        lasting = TORQUE_CONSTANT * one / VISCOUS
        angle += lasting * STEP + (speed - lasting) * (1 - fading) * INERTIA / VISCOUS
        speed = lasting + (speed - lasting) * fading
    read = np.array(angles) + 1e-4 * random.standard_normal(len(angles))
    return rtac.Experiment.of(
        name,
        kind="forced",
        sample_time=STEP,
        cart="clamped",
        initial_arm_angle=0.0,
        arm_angle=read,
        current=sign * current,
    )


@pytest.mark.parametrize(("sign", "told"), [(1.0, False), (-1.0, True)])
def test_a_motor_that_turns_against_its_current_is_told(sign: float, told: bool) -> None:
    recording = rtac.Recording([run(f"run_{n}", sign, n) for n in range(3)], rig={"arm_inertia": INERTIA})
    found = est.least_squares(rtac.RTAC.from_rig(recording), recording, weak=True)
    assert found.estimates["torque_constant"].value == pytest.approx(sign * TORQUE_CONSTANT, rel=0.01)
    assert bool(found.reversed_drive) is told
    if told:
        assert found.reversed_drive.startswith("In closed form torque_constant is -")
        assert "doubt the sign of the current first" in found.reversed_drive
