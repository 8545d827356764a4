"""A motor that turns 30 ms after its command, one step by an encoder: nothing that smooths is named in the place of the delay."""

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from rtac_jax.measurement import Experiment

STEP, COUNT = 0.005, 2 * np.pi / 1000
INERTIA, CONSTANT, DAMPING, DELAY = 0.01, 1.3823, 0.1, 0.03


def stepped() -> rtac.Recording:
    """The response to a step at 0.46 s in closed form: with friction d the speed rises to k/d within J/d."""
    time = STEP * np.arange(329)
    turned = np.maximum(time - 0.46 - DELAY, 0.0)
    slow = INERTIA / DAMPING
    angle = CONSTANT / DAMPING * (turned - slow * (1 - np.exp(-turned / slow)))
    one = Experiment.of(
        "step", kind="forced", sample_time=STEP, cart="clamped", initial_arm_angle=0.0,
        current=np.where(time >= 0.46 - 1e-9, 1.0, 0.0), arm_angle=COUNT * np.floor(angle / COUNT),
    )  # fmt: skip
    return rtac.Recording((one,), {"arm_inertia": INERTIA})


@pytest.mark.slow
def test_a_delay_whose_noise_nobody_knows_is_named_by_simulation() -> None:
    recording = stepped()
    found = est.improve(rtac.RTAC.from_rig(recording), recording, progress=False)
    assert [c.id for c in found.added] == ["input_delay"], found.headline
    assert found.final.parameters["input_delay.delay"].value == pytest.approx(DELAY, abs=1.5e-3)
    for name, truth in (("torque_constant", CONSTANT), ("arm_viscous.positive", DAMPING)):
        assert found.final.parameters[name].value == pytest.approx(truth, rel=0.01)
    assert found.base.parameters["torque_constant"].value < 0.8 * CONSTANT
