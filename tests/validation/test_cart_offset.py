"""A force that hardly changes, recorded with the wrong sign, is to the equations of motion what an offset of the cart is."""

import numpy as np
import pytest

from estimators.validation.channel_consistency import channel_consistency
from rtac_jax.measurement import Experiment, Recording

MASS, STIFFNESS, DAMPING, TIME = 1.0, 550.0, 3.8, 0.008
NUMBER = np.arange(240)


def held(name: str, force: np.ndarray, *, sign: float, offset: float) -> Experiment:
    """The exact response of a cart on a spring to a force that is held from sample to sample, by an encoder of 4 um."""
    decay = DAMPING / (2 * MASS)
    rate = np.sqrt(STIFFNESS / MASS - decay**2)
    cosine, sine = np.exp(-decay * TIME) * np.cos(rate * TIME), np.exp(-decay * TIME) * np.sin(rate * TIME) / rate
    place, speed, read = force[0] / STIFFNESS, 0.0, []  # it begins at rest
    for now in force:
        read.append(place)
        away = place - now / STIFFNESS
        place = now / STIFFNESS + away * cosine + (speed + decay * away) * sine
        speed = speed * cosine - (decay * speed + STIFFNESS / MASS * away) * sine
    rounded = np.round((np.array(read) + offset) / 4e-6) * 4e-6
    return Experiment.of(
        name, kind="forced", sample_time=TIME, arm="locked", cart_position=rounded, disturbance_force=sign * force
    )


@pytest.mark.parametrize(
    ("sign", "offset", "mistake"),
    [
        (1.0, 0.0, None),
        (-1.0, 0.0, "sign of disturbance_force"),
        (1.0, 2e-3, "offset of cart_position"),
        (-1.0, 4e-3, "offset of cart_position"),  # the other one is told once that is mended
    ],
)
def test_a_swapped_sign_of_a_constant_force_is_no_offset(sign: float, offset: float, mistake: str | None) -> None:
    step = held("step", 0.385 * (NUMBER > 0), sign=sign, offset=offset)
    found = channel_consistency(Recording((step,), {"total_mass": MASS})).found
    assert {one.mistake for one in found} == (set() if mistake is None else {mistake})
    if mistake == "sign of disturbance_force":
        assert "multiply disturbance_force by -1" in found[0].sentence
        assert "As well fits where it has none: an offset of cart_position" in found[0].sentence


def test_a_switched_input_is_not_taken_for_a_sensor() -> None:
    """Were it the speed, its two levels would be rounding, and so all that it does."""
    several = []
    for name, level in (("a", 3.457), ("b", 3.99)):
        time = 0.001 * np.arange(400) - 0.065  # 15 ms late
        speed = 27.0 * level * (1 - np.exp(-np.maximum(time, 0.0) / 0.02))
        read = np.round(speed[np.arange(400) // 5 * 5] / 3.245) * 3.245 + 0.13
        several.append(
            Experiment.of(
                name,
                kind="forced",
                sample_time=0.001,
                cart="clamped",
                arm_velocity=read,
                initial_arm_angle=0.0,
                current=np.where(np.arange(400) >= 50, level, 1e-3),
            )
        )
    found = channel_consistency(Recording(several, {"arm_inertia": 1e-4}))
    assert found.residual > 3.0
    assert not [one for one in found.found if "swap" in one.sentence], found
