"""Parts that hit each other between two samples: the filter cannot know at which of them it shows."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from estimators.core.data import Data
from estimators.core.initial_state import scales_of, space_of
from estimators.prediction_error import ekf
from estimators.prediction_error.noise_model import start_variance
from rtac_jax import RTAC, virtual_rig
from rtac_jax.effects import Backlash, CurrentLag, EndStop, HystereticSpring

TACHOMETER = 1


def test_how_far_parts_are_apart_is_known_by_its_unit() -> None:
    model = RTAC.paper() + CurrentLag(0.01) + HystereticSpring(30.0, 1e-3) + Backlash(0.1, 0.3) + EndStop(1e4, 0.03)
    (place,) = ekf.impact_places(model)
    assert tuple(model.states)[place] == "backlash.twist"
    assert ekf.impact_places(RTAC.paper() + EndStop(1e4, 0.03)) == ()


def innovations(*, play: bool) -> np.ndarray:
    """Of the tachometer, with the rig's own values and next to no random force, where several seconds are followed."""
    rig = dataclasses.replace(virtual_rig.Rig().drawn(31), backlash=0.1 if play else 0.0, rotor_share=0.3)
    plans = virtual_rig.standard_plans(seed=32, sample_time=0.002, duration=4.0, free=1, forced=2)
    recording = virtual_rig.record(rig, plans, seed=33)
    model = RTAC.from_rig(recording)
    truth = {
        "total_mass": rig.total_mass, "arm_inertia": rig.arm_inertia, "eccentric_moment": rig.eccentric_moment,
        "spring_stiffness": rig.spring_stiffness, "torque_constant": rig.torque_constant,
        "cart_viscous.coefficient": rig.cart_viscous, "cart_coulomb.level": rig.cart_coulomb,
        "arm_viscous.positive": rig.arm_viscous_positive, "arm_viscous.negative": rig.arm_viscous_negative,
    }  # fmt: skip
    model = model.with_values(truth)
    model = model + Backlash(0.1, 0.3) if play else model
    data, space = Data.of(recording.experiments), space_of(model, recording.experiments, free=[])
    scales = scales_of(model, recording.experiments)
    noise = jnp.asarray([rig.position_noise, rig.velocity_noise, 1.0])
    share = 1e-5**2 * scales.sample_time
    found = ekf.filtered(
        model, data, space, space.physical(space.unconstrained(start=False)),
        sensor_variance=jnp.broadcast_to(noise[:, None] ** 2, (len(noise), data.experiments)),
        process=(share * scales.force**2, share * scales.torque**2),
        start_variance=start_variance(space), substeps=jnp.asarray(1),
    )  # fmt: skip
    return np.asarray(found.innovations)[: data.samples, TACHOMETER].ravel()


@pytest.mark.slow
def test_a_hit_that_shows_a_sample_early_or_late_is_no_surprise() -> None:
    """Of a rig that is not shaken, so that nothing but sensors and hits is random."""
    found, without = innovations(play=True), innovations(play=False)
    assert np.std(found) == pytest.approx(np.std(without), rel=0.02)
    assert np.abs(found).max() < 10  # 100 with a filter that takes the time of a hit for known
