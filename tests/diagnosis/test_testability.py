"""Which effects a recording could show is read off what they declare, never off their names."""

from typing import Any, ClassVar

import numpy as np
import pytest
from small_experiments import DECAY, T, free

from estimators.diagnosis.testability import can_show, stood_for
from rtac_jax.effects import CATALOGUE, Force, Motion, Outputs, Sensor, States
from rtac_jax.measurement import Experiment
from rtac_jax.parameters import Scalar, parameter

LOCKED = free("locked", arm="locked")
CLAMPED = Experiment.of(
    "clamped", kind="forced", sample_time=float(T[1]), cart="clamped", current=np.sin(8 * T), arm_velocity=np.sin(8 * T)
)


class ArmRest(Force):
    """A user's force on the cart whose name begins like those of the arm."""

    id: ClassVar[str] = "arm_rest"
    equation: ClassVar[str] = "-k q^5"
    source: ClassVar[str] = "own rig"
    port: ClassVar[str] = "cart"
    nature: ClassVar[str] = "conservative"

    stiffness: Scalar = parameter(symbol="k", unit="N/m^5", meaning="stiffness", null=0.0, plausible=1e9)

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return -self.stiffness * motion.cart_position**5, 0.0


class Camera(Sensor):
    """A user's sensor of the arm's angle whose name says nothing of it."""

    id: ClassVar[str] = "camera"
    equation: ClassVar[str] = "(1 + g) theta"
    source: ClassVar[str] = "own rig"
    needs_channel: ClassVar[str | None] = "arm_angle"

    error: Scalar = parameter(symbol="g", unit="1", meaning="relative error", null=0.0, plausible=0.03)

    def read(self, outputs: Outputs, own: States) -> Outputs:
        return outputs._replace(arm_angle=outputs.arm_angle * (1.0 + self.error))


def test_a_force_on_the_cart_is_seen_whatever_its_name() -> None:
    assert can_show(ArmRest, [LOCKED])
    assert not can_show(ArmRest, [CLAMPED])


def test_a_sensor_is_seen_where_its_channel_is_measured() -> None:
    angle = free("angle", arm_angle=50 * DECAY)
    assert can_show(Camera, [angle])
    assert not can_show(Camera, [free()])


@pytest.mark.parametrize(
    ("experiment", "seen", "unseen"),
    [
        (
            LOCKED,
            {"cart_coulomb", "lvdt_gain", "channel_delay", "force_offset"},
            {"arm_coulomb", "backlash", "saturation", "gravity_tilt"},  # beside a locked arm a tilt is a constant force
        ),
        (
            CLAMPED,
            {"arm_coulomb", "backlash", "saturation", "tacho_gain"},
            {"cart_coulomb", "lvdt_gain", "encoder_gain", "torque_offset"},
        ),
        (free(), {"torque_offset", "cable_spring"}, {"current_offset", "torque_droop"}),
    ],
)
def test_what_is_held_hides_the_effects_on_it(experiment: Experiment, seen: set[str], unseen: set[str]) -> None:
    shown = {name for name, cls in CATALOGUE.items() if can_show(cls, [experiment])}
    assert seen <= shown
    assert not unseen & shown


def test_an_effect_that_another_stands_for_is_not_called_unshown() -> None:
    """Where a current is played, an offset of it is looked for: nobody need be told that a constant torque was not."""
    assert stood_for(CATALOGUE["torque_offset"], [free(), CLAMPED])
    assert not stood_for(CATALOGUE["torque_offset"], [free()])
    assert not any(stood_for(cls, [CLAMPED]) for name, cls in CATALOGUE.items() if name != "torque_offset")


@pytest.mark.parametrize("measured", ["arm_velocity", "arm_angle"])
@pytest.mark.parametrize(("turns", "shown"), [(9.0, True), (11.0, False)])
def test_a_cable_tears_where_the_arm_turns_many_times(measured: str, turns: float, shown: bool) -> None:
    """One of 8e-6 N m/rad was named on a motor of 400 turns, whose drive has a dead zone."""
    length = float(T[-1] + T[1])
    motion = (
        np.full(len(T), 2 * np.pi * turns / length) if measured == "arm_velocity" else 2 * np.pi * turns * T / length
    )
    spun = Experiment.of(
        "spun", kind="free", sample_time=float(T[1]), cart="clamped", **{measured: motion + 1e-6 * np.sin(T)}
    )
    assert can_show(CATALOGUE["cable_spring"], [LOCKED, spun]) is shown
    assert can_show(CATALOGUE["arm_coulomb"], [LOCKED, spun])
