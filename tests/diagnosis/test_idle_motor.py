"""Where only free decays are recorded, an offset of the drive is a constant torque, and is named as one."""

import pytest
from hidden_effects import diagnosed

from rtac_jax import virtual_rig
from rtac_jax.effects import CATALOGUE

OFFSET = 0.005  # [A]
FEW = [
    CATALOGUE[i] for i in ("torque_offset", "cable_spring", "cogging", "arm_coulomb", "tacho_bias", "current_offset")
]


@pytest.mark.slow
def test_an_offset_of_an_idle_drive_is_a_torque() -> None:
    rig = virtual_rig.Rig(current_offset=OFFSET)
    plans = virtual_rig.standard_plans(seed=11, sample_time=0.005, duration=6.0, free=6, forced=0, repeats=0)
    found = diagnosed(virtual_rig.record(rig, plans, seed=12), FEW)
    assert [c.id for c in found.effects] == ["torque_offset"], found
    torque = found.effects[0].parameters["offset"]
    assert torque.unit == "N m"
    assert abs(torque.value - OFFSET * rig.torque_constant) < 4 * torque.std, torque
