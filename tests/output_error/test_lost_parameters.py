"""A fit that runs to where nothing holds its parameters is no estimate, and neither a diagnosis nor the loop begins there."""

import dataclasses

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from estimators.core.progress import Progress
from estimators.core.results import RESULTS
from estimators.diagnosis.gross_effects import begun_by_equations
from estimators.diagnosis.policy import STANDARD
from estimators.diagnosis.setting import setting_of
from rtac_jax import virtual_rig
from rtac_jax.effects import ArmQuadraticDrag

DRAG, INERTIA = 1e-4, 2.1e-4


@pytest.fixture(scope="module")
def recording() -> rtac.Recording:
    """A heavy cart with a light arm, whose drag goes with the square of the speed, by its encoders; no dry friction."""
    rig = virtual_rig.Rig(
        total_mass=1.0, spring_stiffness=157.9, cart_viscous=0.5, cart_coulomb=0.0, eccentric_moment=3e-3, arm_inertia=INERTIA,
        torque_constant=0.1, arm_viscous_positive=4e-4, arm_viscous_negative=4e-4, arm_quadratic_drag=DRAG, encoder=True,
    )  # fmt: skip
    plans = virtual_rig.standard_plans(
        seed=1, sample_time=0.004, duration=4.0, free=1, forced=2, rest=0, current_rms=1.0, largest_current=10.0
    )
    made = virtual_rig.record(rig, plans, seed=1)
    without_tachometer = tuple(
        dataclasses.replace(e, outputs={c: s for c, s in e.outputs.items() if c != "arm_velocity"})
        for e in made.experiments
    )
    return dataclasses.replace(made, experiments=without_tachometer, rig={"total_mass": made.rig["total_mass"]})


@pytest.fixture(scope="module")
def fit(recording: rtac.Recording) -> est.Fit:
    return est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)


@pytest.mark.slow
def test_the_fit_says_what_it_lost(fit: est.Fit) -> None:
    """The friction that ends on its bound has nothing to do with it."""
    assert fit.on_bounds()
    assert fit.result == RESULTS.undetermined
    assert "arm_inertia" in fit.outcome
    assert "of these the fit says nothing" in fit.outcome


@pytest.mark.slow
def test_another_estimator_is_recommended(recording: rtac.Recording, fit: est.Fit) -> None:
    predicted = est.prediction_error_nonlinear(fit.model, recording, progress=False)
    advice = est.recommended(fit, est.compare(fit, recording).models[0], predicted=predicted)
    assert advice.estimator == "prediction error"
    assert "ended where the data leave parameters free" in advice.sentence


@pytest.mark.slow
def test_a_diagnosis_begins_in_closed_form(recording: rtac.Recording, fit: est.Fit) -> None:
    setting = setting_of(fit, recording, (ArmQuadraticDrag,), Progress("test", show=False))
    assert float(np.asarray(setting.model["arm_inertia"])) == pytest.approx(INERTIA, rel=0.5)
    begun = begun_by_equations(fit, fit.model + ArmQuadraticDrag(DRAG), recording, STANDARD)
    found = est.output_error(begun, recording, from_model=True, progress=False)
    assert found.parameters["arm_inertia"].value == pytest.approx(INERTIA, rel=0.01)
    assert found.parameters["arm_quadratic_drag.coefficient"].value == pytest.approx(DRAG, rel=0.01)


@pytest.mark.slow
def test_the_diagnosis_finds_the_size(recording: rtac.Recording, fit: est.Fit) -> None:
    found = est.diagnose(fit, recording, progress=False)
    assert [c.id for c in found.effects] == ["arm_quadratic_drag"]
    assert found.effects[0].parameters["coefficient"].value == pytest.approx(DRAG, rel=0.02)
