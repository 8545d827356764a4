"""A gear that rubs the more, the more torque it passes on, on a motor of its own: small steps in NumPy, friction that holds."""

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from rtac_jax.effects import CATALOGUE

INERTIA, TORQUE, VISCOUS, DRY = 2e-4, 0.05, 5e-4, 5e-4
SAMPLE_TIME, SAMPLES, INNER = 0.005, 800, 50
COUNT = 2 * np.pi / 4096


def turned(current: np.ndarray, driving: float, braking: float) -> np.ndarray:
    """The angle of the arm at each sample: the trapezoidal rule, with friction that takes all of the speed or as much as it can."""
    step, speed, angle, angles = SAMPLE_TIME / INNER, 0.0, 0.0, []
    for held in np.repeat(current, INNER).reshape(-1, INNER):
        angles.append(angle)
        for now in held:
            torque = TORQUE * now
            free = (speed + step * torque / INERTIA) / (1 + step * VISCOUS / INERTIA)
            level = DRY + (driving if torque * free > 0 else braking) * abs(torque)
            taken = np.clip(free, -step * level / INERTIA, step * level / INERTIA)
            speed, before = free - taken, speed
            angle += step * 0.5 * (speed + before)
    return np.array(angles)


def geared(driving: float, braking: float) -> rtac.Recording:
    random = np.random.default_rng(5)
    experiments = []
    for number in range(4):
        current = np.repeat(
            random.normal(0, 0.4, SAMPLES // 20), 20
        )  # held for a tenth of a second, so that it brakes, too
        angle = COUNT * np.round(turned(current, driving, braking) / COUNT)
        experiments.append(
            rtac.Experiment.of(
                f"run {number}",
                kind="forced",
                sample_time=SAMPLE_TIME,
                current=current,
                arm_angle=angle,
                cart="clamped",
            )
        )
    return rtac.Recording(tuple(experiments), rig={"arm_inertia": INERTIA})


def test_what_acts_while_the_motor_drives_and_while_it_brakes_is_said() -> None:
    said = CATALOGUE["arm_load_friction"](0.2).remark(rtac.RTAC.paper().with_values({"torque_constant": 0.05}).body)
    assert "0.04 N m/A while the motor drives and 0.06 while it brakes" in said


@pytest.mark.slow
@pytest.mark.parametrize(("driving", "braking"), [(0.2, 0.2), (0.1, 0.3)])
def test_it_is_found_beside_dry_friction_and_tells_what_acts_where_it_drives_and_brakes(
    driving: float, braking: float
) -> None:
    recording = geared(driving, braking)
    found = est.improve(rtac.RTAC.from_rig(recording), recording, progress=False)
    assert {c.id for c in found.added} == {"arm_load_friction", "arm_coulomb"}, found
    assert found.mended == "adequate"
    torque, fraction = (found.final.parameters[n] for n in ("torque_constant", "arm_load_friction.fraction"))
    for sign, truth in ((-1, driving), (1, braking)):
        acting = torque.value * (1 + sign * fraction.value)
        assert acting == pytest.approx(TORQUE * (1 + sign * truth), rel=0.005)
    assert found.final.parameters["arm_coulomb.level"].value == pytest.approx(DRY, rel=0.05)


@pytest.mark.slow
def test_a_gear_that_does_not_rub_so_is_not_said_to() -> None:
    recording = geared(0.0, 0.0)
    found = est.improve(rtac.RTAC.from_rig(recording), recording, progress=False)
    assert {c.id for c in found.added} == {"arm_coulomb"}, found
    assert found.mended == "adequate"
