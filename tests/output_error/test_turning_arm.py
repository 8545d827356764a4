"""A driven arm in a vertical plane that turns over: of a long simulation its start and parameters have many best values."""

import dataclasses

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from rtac_jax import virtual_rig
from rtac_jax.effects import ArmCoulomb, GravityTilt

COUNT = 2 * np.pi / 2000  # of the encoder [rad]
RIG = virtual_rig.Rig(tilt_across=np.pi / 2, arm_coulomb=6e-4, encoder=True)


def recorded(seed: int, current: float) -> rtac.Recording:
    """Three runs of 6 s at 250 Hz from rest, which only an encoder shows."""
    plans = [
        dataclasses.replace(
            plan,
            cart="clamped",
            initial_position=0.0,
            initial_velocity=0.0,
            initial_angle=0.0,
            initial_arm_velocity=0.0,
        )
        for plan in virtual_rig.standard_plans(
            seed=seed, sample_time=0.004, duration=6.0, free=0, forced=3, rest=0, current_rms=current
        )
    ]
    whole = virtual_rig.record(RIG, plans, seed=seed)
    shown = []
    for e in whole.experiments:
        angle = e.outputs["arm_angle"]
        counted = dataclasses.replace(angle, values=COUNT * np.round(angle.values / COUNT))
        shown.append(dataclasses.replace(e, outputs={"arm_angle": counted}))
    return dataclasses.replace(whole, experiments=tuple(shown))


def test_a_comparison_finds_where_the_arm_began() -> None:
    recording = recorded(2, 0.4)
    body = rtac.RTAC.from_rig(recording).with_values(
        {
            "torque_constant": RIG.torque_constant,
            "arm_viscous.positive": RIG.arm_viscous_positive,
            "arm_viscous.negative": RIG.arm_viscous_negative,
        }
    )
    model = body + GravityTilt(along=0.0, across=1.0) + ArmCoulomb(RIG.arm_coulomb)
    found = est.compare(model, recording).models[0]
    assert max(abs(float(trace.simulated[-1]) / (2 * np.pi)) for trace in found.traces) > 1  # it does turn over
    assert max(trace.rms / trace.noise for trace in found.traces) < 4.0


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "current"), [(2, 0.1), *((seed, 0.4) for seed in (1, 2, 3, 4))])
def test_a_fit_begins_with_what_a_simulation_follows(seed: int, current: float) -> None:
    recording = recorded(seed, current)
    model = rtac.RTAC.from_rig(recording) + GravityTilt(along=0.0, across=0.9) + ArmCoulomb(4e-4)
    found = est.output_error(model, recording, progress=False)
    assert found.residual_std["arm_angle"] < 1.3 * found.noise["arm_angle"]
    assert found.parameters["arm_coulomb.level"].value == pytest.approx(RIG.arm_coulomb, rel=0.02)
    assert found.parameters["gravity_tilt.across"].value == pytest.approx(1.0, rel=0.01)
