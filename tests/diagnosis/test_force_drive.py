"""What the drive of a cart does to the force that is recorded is named, in the independent rig, whose arm is locked."""

import dataclasses
from typing import Any

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from estimators.closed_form.motion_regression import motion_regression
from estimators.core.data import moving, pieces
from estimators.core.progress import Progress
from estimators.core.sensor_noise import noise_levels
from estimators.diagnosis.setting import set_up
from rtac_jax import virtual_rig
from rtac_jax.effects import CATALOGUE

STEP = 0.004
RIG = virtual_rig.Rig(total_mass=1.77, spring_stiffness=390.0, cart_viscous=2.5, cart_coulomb=0.3, position_range=0.05)
HIDDEN: dict[str, tuple[dict[str, float], str, float]] = {
    "force_dead_zone": ({"force_dead_zone": 0.4}, "threshold", 0.4),
    "force_saturation": ({"force_saturation": 3.2}, "inverse_limit", 1 / 3.2),
    "force_delay": ({"force_delay": 0.008}, "delay", 0.008),
    "force_lag": ({"force_lag": 0.006}, "time_constant", 0.006),
    "force_droop": ({"force_droop": 0.05}, "droop", 0.05),
}
FEW = tuple(CATALOGUE[n] for n in (*HIDDEN, "cubic_spring", "cart_quadratic_drag", "force_offset"))


def recorded(hidden: dict[str, Any]) -> rtac.Recording:
    """Two decays, and a cart that is driven by steps and by a sum of sines."""
    time = STEP * np.arange(1000)
    steps = 4.5 * np.sign(np.sin(2.1 * time + 0.1)) * (1 + 0.3 * np.sign(np.sin(0.9 * time + 1.0)))
    sines = 1.5 * (np.sin(5 * time) + np.sin(11.3 * time + 1) + np.sin(19.7 * time + 2))
    plans = [
        virtual_rig.Plan(f"decay_{n}", "free", 4.0, STEP, initial_position=x, arm="locked")
        for n, x in ((1, 0.03), (2, -0.02))
    ]
    plans += [
        virtual_rig.Plan(name, "forced", 4.0, STEP, disturbance_force=force, arm="locked")
        for name, force in (("steps", steps), ("sines", sines))
    ]
    plans.append(virtual_rig.Plan("rest", "rest", 2.0, STEP))
    return virtual_rig.record(dataclasses.replace(RIG, **hidden), plans, seed=3)


@pytest.mark.slow
@pytest.mark.parametrize("name", HIDDEN)
def test_what_the_drive_does_to_the_force_is_named_with_its_size(name: str) -> None:
    hidden, parameter, truth = HIDDEN[name]
    recording = recorded(hidden)
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    found = est.diagnose(fit, recording, candidates=FEW, progress=False)
    named = {c.id: c for c in found.effects}
    assert found.verdict in ("missing", "ambiguous"), found
    assert name in named, found
    # A delay and a lag of few samples may be two names of one thing; what only one of them does is told.
    assert set(named) - {name} <= ({"force_delay", "force_lag"} if name in ("force_delay", "force_lag") else set())
    estimate = named[name].parameters[parameter]
    assert estimate.value == pytest.approx(truth, abs=4 * estimate.std)
    assert estimate.std < 0.05 * truth


def test_the_equations_of_motion_see_what_the_drive_delivers() -> None:
    recording = recorded({"force_saturation": 1.5})
    levels = noise_levels(recording.experiments)
    model = rtac.RTAC.from_rig(recording)
    stiffness = []
    for several in (model, model + CATALOGUE["force_saturation"](1 / 1.5)):
        equations = motion_regression(several, pieces(moving(recording)), levels)
        assert equations is not None
        stiffness.append(equations.solved().values["spring_stiffness"])
    assert stiffness[1] == pytest.approx(390.0, rel=0.01)
    assert abs(stiffness[0] / 390.0 - 1) > 0.05


def test_without_a_force_none_of_them_is_asked() -> None:
    recording = recorded({})
    decays = recording.select(["decay_1", "decay_2", "rest"])
    for told, asked in ((recording, set(HIDDEN)), (decays, set())):
        setting = set_up(rtac.RTAC.from_rig(told), told, FEW, {}, 1, Progress("test", show=False))
        assert set(setting.absent) & set(HIDDEN) == asked


def test_random_forces_average_over_a_swing_of_the_spring_though_its_drive_is_slow() -> None:
    """Steps every few seconds show most, and a cart on its spring swings twenty times as fast."""
    time = STEP * np.arange(4000)
    slow = 3.0 * np.sin(0.8 * time)
    plan = virtual_rig.Plan("slow", "forced", 16.0, STEP, disturbance_force=slow, arm="locked")
    recording = virtual_rig.record(RIG, [plan], seed=4)
    model = rtac.RTAC.from_rig(recording).with_values({"spring_stiffness": 390.0})
    setting = set_up(model, recording, FEW, {}, 1, Progress("test", show=False))
    assert setting.samples_per_radian == pytest.approx(np.sqrt(1.77 / 390.0) / STEP, rel=1e-3)
