"""A loop whose time is over at any of its steps: it answers all the same, and no sentence blames the model for that."""

import math

import numpy as np
import pytest
from known_search import Known, known, sized

import estimators as est
import rtac_jax as rtac
from estimators.core.deadline import Deadline
from estimators.diagnosis.improvement_loop import OUT_OF_TIME
from estimators.diagnosis.policy import STANDARD
from estimators.diagnosis.stepwise_selection import improvements
from estimators.misspecification.findings import Findings
from estimators.reporting.report import report_dict
from rtac_jax.effects import ArmQuadraticDrag, CurrentOffset, TorqueDroop

INERTIA, VISCOUS, TORQUE_CONSTANT, OFFSET = 4e-5, 2e-4, 0.06, 0.02  # kg m^2, N m s, N m/A, A
SAMPLE_TIME, COUNTS = 0.005, 8000
CANDIDATES = [ArmQuadraticDrag, CurrentOffset, TorqueDroop]
# What is said of models that were tried, and of nothing else.
FALSE = ("diverges", "does not serve", "do not serve", "would not fall", "do not confirm", "no effect of the catalogue")


def drive(name, seed):
    """Record four seconds of a drive whose current is recorded too small by an offset; its motion is exact between samples."""
    random = np.random.default_rng(seed)
    phases = random.uniform(0, 2 * np.pi, 5)
    time = SAMPLE_TIME * np.arange(round(4.0 / SAMPLE_TIME))
    lines = np.sin(np.outer(time, [1.0, 2.3, 4.1, 7.7, 13.0]) + phases).sum(axis=1)
    current = 0.15 * np.tanh(lines / 1.5)
    rate, angle, speed = VISCOUS / INERTIA, 0.0, 0.0
    angles = np.zeros(len(time))
    for k, one in enumerate(current):
        angles[k] = angle
        lasting = TORQUE_CONSTANT * (one + OFFSET) / INERTIA / rate
        fading = -math.expm1(-rate * SAMPLE_TIME)
        angle += lasting * SAMPLE_TIME + (speed - lasting) * fading / rate
        speed += (lasting - speed) * fading
    turn = 2 * np.pi / COUNTS
    return rtac.Experiment.of(
        name, kind="forced", sample_time=SAMPLE_TIME, cart="clamped", initial_arm_angle=0.0,
        arm_angle=turn * np.round(angles / turn), current=current,
    )  # fmt: skip


@pytest.fixture(scope="module")
def recording():
    return rtac.Recording(
        [drive(f"run_{n}", seed=n) for n in range(4)],
        rig={"arm_inertia": INERTIA, "eccentric_moment": 1e-3, "total_mass": 1.0, "spring_stiffness": 100.0},
    )


def improved(recording, **options):
    return est.improve(
        rtac.RTAC.from_rig(recording), recording, candidates=CANDIDATES, thorough=False, progress=False, **options
    )


@pytest.fixture(scope="module")
def whole(recording):
    """The loop that goes on to its end, and how often it looked at the time."""
    asked = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Deadline, "over", property(lambda self: math.isfinite(self.seconds) and bool(asked.append(self))))
        found = improved(recording, within=1e6)
    return found, len(asked)


def stopped(recording, monkeypatch, after):
    """Run the loop with a time that is over once it was looked at so often."""
    looks = iter(range(after))
    monkeypatch.setattr(
        Deadline, "over", property(lambda self: math.isfinite(self.seconds) and next(looks, None) is None)
    )
    return improved(recording, within=1e6)


@pytest.mark.slow
def test_with_enough_time_the_offset_is_named(whole):
    found, asked = whole
    assert [c.id for c in found.added] == ["current_offset"]
    assert found.final.model["current_offset.offset"] == pytest.approx(OFFSET, rel=0.02)
    # By the motor constant beside the offset: that of the model without it is off by more than the digits that are told.
    assert float(found.fits[0].model["torque_constant"]) < 0.99 * TORQUE_CONSTANT
    assert f"dry friction that is {OFFSET * TORQUE_CONSTANT:.3g} N m more one way" in found.diagnoses[0].explanation
    assert not found.broken_off
    assert asked > 30
    assert report_dict(found)["broken_off"] is False


@pytest.mark.slow
@pytest.mark.parametrize("fraction", [0.0, 0.2, 0.45, 0.7, 0.9])
def test_whenever_the_time_is_over_there_is_an_answer_that_says_so(recording, whole, monkeypatch, fraction):
    _, asked = whole
    found = stopped(recording, monkeypatch, round(fraction * asked))
    assert found.broken_off
    assert report_dict(found)["broken_off"] is True
    told = " ".join([found.headline, found.ending, *(d.explanation for d in found.diagnoses)])
    assert [words for words in FALSE if words in told] == []
    assert "time" in told
    assert not found.settled
    if not found.added and found.not_added:
        assert found.verdict in ("missing", "ambiguous")
        assert "current_offset" in found.headline
    if found.stopped.startswith(OUT_OF_TIME):
        assert found.mended is None or found.not_added


@pytest.mark.slow
def test_without_time_nothing_is_fitted_and_the_evidence_knows(recording):
    found = improved(recording, within=0.0)
    first = found.diagnoses[0]
    assert "current_offset" in first.broken_off
    assert not any(candidate.refitted for candidate in first.candidates)
    assert "The time that was given was over before" in first.explanation
    assert found.headline.startswith(
        "The model fails, and no effect that was fitted before the time was over explains it."
    )
    assert first.evidence.broken_off == first.broken_off
    assert any("time was over" in one for one in est.judge(first.evidence).incomplete)


def test_what_was_not_fitted_in_time_is_a_rival_of_what_was():
    """Else the first of two that explain as much would be missing for certain, as the other was never asked."""
    search = Known(known(base=-1000.0, cubic_spring=-900.0))
    search.rejects = lambda model: Findings(() if model.added else (sized("cubic_spring", 190.0, 1e-9),))
    for late in ((), ("lvdt_gain", "cubic_spring")):
        search.late = late
        ((found,), _) = improvements(search, search.base, search.rejects(search.base), STANDARD)
        assert found.id == "cubic_spring"
        assert found.rivals == found.late == late[:1]
