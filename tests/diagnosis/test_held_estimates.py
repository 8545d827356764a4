"""What is held at an estimate is not exact: deviations of the other parameters count that, by every set of assumptions."""

import dataclasses

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from estimators.diagnosis.held_estimates import counting_held
from rtac_jax import virtual_rig
from rtac_jax.effects import ArmCoulomb

HELD = "arm_coulomb.level"


@pytest.fixture(scope="module")
def recording() -> rtac.Recording:
    """A recording whose scale of torques nothing tells but an inertia known to 5 %."""
    rig = virtual_rig.Rig(arm_coulomb=3e-4)
    standard = virtual_rig.standard_plans(seed=3, duration=2.0, free=0, forced=2, rest=1)
    plans = [dataclasses.replace(plan, cart="clamped") for plan in standard]
    recorded = virtual_rig.record(rig, plans, seed=4)
    constants = {"arm_inertia": rig.arm_inertia, "arm_inertia_std": 0.05 * rig.arm_inertia}
    arm = [dataclasses.replace(e, outputs={"arm_velocity": e.outputs["arm_velocity"]}) for e in recorded]
    return rtac.Recording(arm, constants)


@pytest.fixture(scope="module")
def free(recording: rtac.Recording) -> est.Fit:
    model = rtac.RTAC.from_rig(recording) + ArmCoulomb(1e-4)
    return est.output_error(model, recording, progress=False)


@pytest.fixture(scope="module")
def held(recording: rtac.Recording, free: est.Fit) -> est.Fit:
    return est.output_error(free.model.fix(HELD), recording, from_model=True, progress=False)


def deviations(fit: est.Fit) -> dict[str, float]:
    return {name: p.std for name, p in fit.parameters.items() if not p.is_fixed and name != HELD}


@pytest.mark.slow
def test_they_are_those_of_a_fit_that_estimates_all(recording: rtac.Recording, free: est.Fit, held: est.Fit) -> None:
    """A held torque fixes the scale of the others; what is then counted is the identity of the partitioned inverse."""
    counted = counting_held(held, recording, {HELD: free.parameters[HELD].std})
    wanted, exact, got = deviations(free), deviations(held), deviations(counted)
    assert min(wanted[name] / exact[name] for name in ("arm_inertia", "torque_constant")) > 3
    for name, std in wanted.items():
        assert got[name] == pytest.approx(std, rel=0.01)
    assert counted.parameters[HELD].std == free.parameters[HELD].std
    assert {name: std for name, _, std, _ in counted.rows()}[HELD] != "fixed"
    assert counted.correlations().matrix == pytest.approx(free.correlations().matrix[:-1, :-1], abs=0.02)


@pytest.mark.slow
def test_all_sets_of_assumptions_count_it(recording: rtac.Recording, free: est.Fit, held: est.Fit) -> None:
    counted = est.covariances(counting_held(held, recording, {HELD: free.parameters[HELD].std}), recording)
    alone, wanted = est.covariances(held, recording), est.covariances(free, recording)
    for kind in ("plain", "sandwich"):
        assert counted.std(kind)["torque_constant"] > 3 * alone.std(kind)["torque_constant"]
        assert counted.std(kind)["torque_constant"] == pytest.approx(wanted.std(kind)["torque_constant"], rel=0.1)


def test_what_depends_on_the_whole_model_is_not_said_to_be_less_sure_than_the_data_have_it(
    recording: rtac.Recording, free: est.Fit, held: est.Fit
) -> None:
    """All torques scale together: the arm's response by the current does not change, however unsure the scale is."""
    counted = counting_held(held, recording, {HELD: free.parameters[HELD].std})
    assert np.array_equal(counted.information.own_covariance, held.information.covariance)


def test_what_is_exact_or_free_adds_nothing(recording: rtac.Recording, free: est.Fit, held: est.Fit) -> None:
    assert counting_held(held, recording, {HELD: 0.0}) is held
    assert counting_held(free, recording, {HELD: 1e-5}) is free
