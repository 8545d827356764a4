"""Gross effects, hidden in the independent virtual rig, are named although the fit of the base model follows nothing."""

import dataclasses
import math
from typing import Any

import pytest

import estimators as est
import rtac_jax as rtac
from estimators.core.data import Data, moving, pieces
from estimators.core.progress import Progress
from estimators.diagnosis.gross_effects import placed_inside, screened_by_equations
from estimators.diagnosis.policy import STANDARD
from estimators.diagnosis.setting import set_up
from estimators.inference.shaken_simulation import unfollowed
from rtac_jax import virtual_rig
from rtac_jax.effects import CATALOGUE

RIG = virtual_rig.Rig().drawn(100)
# What the rig hides, the rms of the current, the arm's speed at the start, and a size that should come out.
HIDDEN: dict[str, tuple[dict[str, Any], float, float, tuple[str, float]]] = {
    "gravity_tilt": ({"tilt_across": math.pi / 2}, 0.16, 0.0, ("across", 9.81 / 9.80665)),
    "cable_spring": ({"cable_stiffness": 0.05, "cable_home": 0.4}, 0.16, 0.0, ("stiffness", 0.05)),
    "one_sided_spring": ({"one_sided_spring": RIG.spring_stiffness}, 0.16, 0.0, ("stiffness", RIG.spring_stiffness)),
    # Ten times the drive: it never turns the arm, whose speed at the start a viscous friction follows well.
    "arm_coulomb": ({"arm_coulomb": 0.013}, 0.016, 30.0, ("level", 0.013)),
}
# Followed well enough that the equations are not asked; where the arm stops at once, the size is known roughly only.
FOLLOWED = ("arm_coulomb",)


def recorded(name: str) -> rtac.Recording:
    """A free decay and two forced runs whose arm begins near 0.4 rad, in some cases at a speed."""
    hidden, rms, speed, _ = HIDDEN[name]
    plans = virtual_rig.standard_plans(seed=7, sample_time=0.005, duration=5.0, free=1, forced=2, current_rms=rms)
    starts = [
        dataclasses.replace(plan, initial_angle=0.4 + 0.3 * n, initial_arm_velocity=speed * (-1) ** n)
        for n, plan in enumerate(plans)
    ]
    return virtual_rig.record(dataclasses.replace(RIG, **hidden), starts, seed=8)


@pytest.mark.slow
@pytest.mark.parametrize("name", HIDDEN)
def test_a_gross_effect_is_named_with_its_size(name: str) -> None:
    recording = recorded(name)
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    data = Data.of(pieces(moving(recording)))
    followed = unfollowed(fit, data, STANDARD.simulation) < STANDARD.unfollowed
    assert followed == (name in FOLLOWED)
    found = est.diagnose(fit, recording, progress=False)
    assert found.verdict == "missing", found
    assert [c.id for c in found.effects] == [name], found
    size, truth = HIDDEN[name][3]
    assert found.effects[0].parameters[size].value == pytest.approx(truth, rel=0.15 if followed else 0.01)
    assert not any(test.rejects for test in found.left)
    assert found.evidence is not None
    assert ("equations" in {refit.way for refit in found.evidence.refits}) != followed
    assert est.judge(found.evidence).effects == (name,)


@pytest.mark.slow
def test_the_loop_mends_a_model_that_followed_nothing() -> None:
    recording = recorded("cable_spring")
    found = est.improve(rtac.RTAC.from_rig(recording), recording, validation=["forced_2"], progress=False)
    assert [c.id for c in found.added] == ["cable_spring"]
    errors = found.validation.models[-1].errors
    assert all(error.rms_over_noise < 1.3 for error in errors.values()), found


def test_an_inertia_that_nobody_gave_is_found_beside_what_is_missing() -> None:
    """A fit that follows nothing runs away with it: to a ten-millionth, of a crane's pendulum."""
    recording = recorded("gravity_tilt")
    rig = {name: value for name, value in recording.rig.items() if name != "arm_inertia"}
    unknown = dataclasses.replace(recording, rig=rig)
    model = rtac.RTAC.from_rig(unknown).with_values({"arm_inertia": 1e-11, "eccentric_moment": 1e-9})
    assert "arm_inertia" in model.free
    classes = [CATALOGUE[n] for n in ("gravity_tilt", "cable_spring", "cogging", "cubic_spring")]
    setting = set_up(model, unknown, classes, {}, 4, Progress("test", show=False))
    first = screened_by_equations(setting, model)[0]
    assert first.id == "gravity_tilt"
    assert first.values["arm_inertia"] == pytest.approx(RIG.arm_inertia, rel=0.3)
    placed = placed_inside(model, first.values)
    assert float(placed["eccentric_moment"]) == pytest.approx(RIG.eccentric_moment, rel=0.3)


def test_what_is_fixed_on_a_bound_stays_there() -> None:
    """A hundredth of a tilt's zeroing that was moved off its bound was named as an offset of the sensor."""
    body = rtac.RTAC.from_rig(
        virtual_rig.record(virtual_rig.Rig(), virtual_rig.standard_plans(seed=1, duration=1.0), seed=1)
    )
    model = (body + CATALOGUE["gravity_tilt"](along=0.01, across=0.0, zeroed=0.0)).fix("gravity_tilt.zeroed")
    values = {"gravity_tilt.zeroed": 0.0, "gravity_tilt.along": 0.02, "cart_coulomb.level": 0.0}
    placed = placed_inside(model, values)
    assert float(placed["gravity_tilt.zeroed"]) == 0.0
    assert float(placed["gravity_tilt.along"]) == 0.02
    assert float(placed["cart_coulomb.level"]) > 0.0
