"""The range of speeds over which a missing force is looked for: all that was recorded, and not a multiple of the rms."""

import numpy as np
import pytest

import rtac_jax as rtac
from estimators.core.progress import Progress
from estimators.diagnosis import innovation_tests
from estimators.diagnosis.setting import set_up
from rtac_jax import virtual_rig


def test_a_decay_that_is_several_times_as_fast_as_the_rms_is_within_it() -> None:
    """Beside forced runs that hardly move the cart."""
    rig = virtual_rig.Rig(cart_coulomb=0.0)
    plans = virtual_rig.standard_plans(
        seed=7, sample_time=0.004, duration=6.0, free=1, forced=4, rest=1, current_rms=0.05
    )
    recording = virtual_rig.record(rig, plans, seed=8)
    setting = set_up(
        rtac.RTAC.from_rig(recording), recording, [rtac.effects.Cogging], {}, 2, Progress("test", show=False)
    )
    low, high = innovation_tests._ranges(setting)["cart_velocity"]
    speeds = [
        rtac.measurement.central_difference(e.outputs["cart_position"].values, sample_time=e.sample_time)
        for e in recording
        if e.kind != "rest"
    ]
    fastest, rms = max(np.quantile(np.abs(v), 0.999) for v in speeds), np.sqrt(np.mean(np.concatenate(speeds) ** 2))
    assert fastest > 3.5 * rms
    assert (-low, high) == (pytest.approx(fastest, rel=0.15), pytest.approx(fastest, rel=0.15))
