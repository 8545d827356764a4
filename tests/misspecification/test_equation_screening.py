"""Gross effects of the independent virtual rig come out of the equations of motion by name and size, without a simulation."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

import rtac_jax as rtac
from estimators.closed_form.motion_regression import MotionRegression, motion_regression
from estimators.core.data import moving, pieces
from estimators.core.initial_state import scales_of
from estimators.core.sensor_noise import noise_levels
from estimators.misspecification.equation_screening import Explained, explained_by
from rtac_jax import virtual_rig
from rtac_jax.effects import CATALOGUE, Effect
from rtac_jax.effects.one_sided_spring import OneSidedSpring

RIG = virtual_rig.Rig().drawn(100)
G = 9.81  # of the virtual rig; an effect of the catalogue counts in units of the standard one
# What the rig hides, the current's rms, the arm's speed at the start, and the sizes that should come out.
GROSS: dict[str, tuple[dict[str, Any], float, float, dict[str, float]]] = {
    "gravity_tilt": ({"tilt_across": math.pi / 2}, 0.02, 0.0, {"across": G / 9.80665, "along": 0.0}),
    "cable_spring": ({"cable_stiffness": 0.05, "cable_home": 0.4}, 0.03, 0.0, {"stiffness": 0.05, "torque": 0.02}),
    "arm_coulomb": ({"arm_coulomb": 0.013}, 0.016, 30.0, {"level": 0.013}),
    "one_sided_spring": ({"one_sided_spring": RIG.spring_stiffness}, 0.16, 0.0, {"stiffness": RIG.spring_stiffness}),
}


def recorded(hidden: dict[str, Any], rms: float, speed: float) -> rtac.Recording:
    """Of a rig, a free decay and two forced runs whose arm begins near 0.4 rad, some of them at a speed."""
    plans = virtual_rig.standard_plans(seed=7, sample_time=0.005, duration=5.0, free=1, forced=2, current_rms=rms)
    starts = [
        dataclasses.replace(plan, initial_angle=0.4 + 0.3 * n, initial_arm_velocity=speed * (-1) ** n)
        for n, plan in enumerate(plans)
    ]
    return virtual_rig.record(dataclasses.replace(RIG, **hidden), starts, seed=8)


def equations(recording: rtac.Recording, model: rtac.RTAC | None = None) -> MotionRegression:
    model = rtac.RTAC.from_rig(recording) if model is None else model
    found = motion_regression(model, pieces(moving(recording)), noise_levels(recording.experiments))
    assert found is not None
    return found


def screened(recording: rtac.Recording, candidates: Sequence[type[Effect]]) -> list[Explained]:
    model = rtac.RTAC.from_rig(recording)
    scales = scales_of(model, pieces(moving(recording)))
    instances = [one for c in candidates if c.id not in model for one in c.candidates(scales)]
    return explained_by(equations(recording), instances, least=10.0, most=3)


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] * (name in ("gravity_tilt", "cable_spring"))) for name in GROSS],
)
def test_gross_effects_come_first_with_their_sizes(name: str) -> None:
    hidden, rms, speed, sizes = GROSS[name]
    found = screened(recorded(hidden, rms, speed), [*CATALOGUE.values(), OneSidedSpring])
    first = found[0]
    assert first.id == name
    assert first.selected
    assert first.statistic > 10.0 + max((e.statistic for e in found[1:]), default=0.0)
    largest = max(map(abs, sizes.values()))
    for one, begin in zip(first.amplitudes, first.begin, strict=True):
        assert begin == pytest.approx(sizes[one], abs=0.03 * largest), one
    # Beside it the base model's own parameters are right.
    assert first.values["spring_stiffness"] == pytest.approx(RIG.spring_stiffness, rel=0.01)
    assert first.values["torque_constant"] == pytest.approx(RIG.torque_constant, rel=0.1)


def test_nothing_is_selected_where_nothing_is_missing() -> None:
    found = screened(recorded({}, 0.16, 0.0), list(CATALOGUE.values()))
    assert not any(e.selected for e in found)
    assert all(e.statistic < 5.0 for e in found)


@pytest.mark.slow
@pytest.mark.parametrize("shaken", [{}, {"force_noise": 1e-3, "torque_noise": 3e-5}])
def test_nothing_is_selected_on_forty_rigs_without_anything_hidden(shaken: dict[str, float]) -> None:
    """Gains are counted so that chance brings none: neither a selection nor a small p-value."""
    jobs = []
    for number in range(40):
        plans = virtual_rig.standard_plans(seed=600 + number, duration=5.0, free=1, forced=2, rest=1)
        jobs.append((dataclasses.replace(virtual_rig.Rig().drawn(700 + number), **shaken), plans, 800 + number))
    for recording in virtual_rig.record_many(jobs):
        found = screened(recording, [*CATALOGUE.values(), OneSidedSpring])
        assert not any(e.selected for e in found)
        assert all(e.p_value > 0.01 for e in found)


def test_what_the_model_has_already_is_not_asked_for_again() -> None:
    hidden, rms, speed, _ = GROSS["cable_spring"]
    recording = recorded(hidden, rms, speed)
    bare, known = rtac.RTAC.from_rig(recording), CATALOGUE["cable_spring"]
    errors = [equations(recording, model).solved().squares for model in (bare, bare + known(0.05, 0.02))]
    assert errors[1][1] < 1e-2 * errors[0][1]
    assert errors[1][0] == pytest.approx(errors[0][0], rel=0.1)


def test_without_the_motion_of_a_free_arm_there_are_no_equations() -> None:
    recording = recorded({}, 0.16, 0.0)
    blind = [
        dataclasses.replace(e, outputs={"cart_position": e.outputs["cart_position"]}) for e in recording.experiments
    ]
    experiments = pieces(moving(dataclasses.replace(recording, experiments=tuple(blind))))
    assert motion_regression(rtac.RTAC.from_rig(recording), experiments, {"cart_position": 2e-5}) is None


def test_a_random_column_gains_nothing() -> None:
    """Over many columns of noise that explain nothing: the gain is negative on average, and never strong evidence."""
    system = equations(recorded({}, 0.16, 0.0))
    offset = system.beside(CATALOGUE["force_offset"](0.01))[0]
    random = np.random.default_rng(3)
    base = system.solved()
    gains = []
    for _ in range(500):
        columns = np.convolve(random.standard_normal(len(system.target)), np.ones(8), "same")[:, None]
        gains.append(system.gain(base, system.solved([offset._replace(columns=columns)]), 1))
    assert np.mean(gains) < 0
    assert max(gains) < 10
