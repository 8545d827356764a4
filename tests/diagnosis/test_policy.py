"""A policy of one's own changes what is judged, and only that."""

import dataclasses
import importlib
from typing import Any

import numpy as np
import pytest
from known_search import Known, force, known, screened, sized

import estimators as est
from estimators.diagnosis.choice import chosen
from estimators.diagnosis.policy import STANDARD, DiagnosisPolicy
from estimators.diagnosis.stepwise_selection import improvements
from estimators.misspecification.adequacy import adequacy_tests
from estimators.misspecification.candidate_screening import Screened
from estimators.misspecification.detection_limit import is_testable, may_show
from estimators.misspecification.findings import Findings
from rtac_jax.effects import CubicSpring, GravityTilt

GAINS = known(base=-1000.0, cubic_spring=-900.0, lvdt_lag=-903.0)


def step(policy: DiagnosisPolicy):
    search = Known(GAINS)
    tried = {name: (screened(name), search.model(name)) for name in ("cubic_spring", "lvdt_lag")}
    return chosen(search, search.model(), tried, policy)


def test_the_gain_that_is_asked_decides_whether_anything_is_chosen() -> None:
    found = step(STANDARD)
    assert found is not None
    assert found.id == "cubic_spring"
    assert step(dataclasses.replace(STANDARD, bic_gain=1000.0)) is None


def test_the_gain_within_which_rivals_count_decides_who_is_one() -> None:
    strict = dataclasses.replace(STANDARD, bic_gain=1.0)
    for policy, rivals in ((STANDARD, ("lvdt_lag",)), (strict, ())):
        found = step(policy)
        assert found is not None
        assert found.rivals == rivals


def test_every_threshold_has_a_meaning_and_a_source() -> None:
    for field in dataclasses.fields(DiagnosisPolicy):
        assert field.metadata["meaning"]
        assert field.metadata["source"]
        assert field.name in str(STANDARD)
    assert set(STANDARD.as_dict()) == {field.name for field in dataclasses.fields(DiagnosisPolicy)}


@pytest.mark.parametrize(
    ("wrong", "said"),
    [({"removed": 1.5}, "fraction"), ({"effects": 0}, "1 or more"), ({"bic_gain": -1.0}, "not negative")],
)
def test_what_is_no_threshold_is_refused(wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said) as caught:
        est.DiagnosisPolicy(**wrong)
    assert next(iter(wrong)) in str(caught.value)


@pytest.mark.parametrize("module", ["adequacy", "candidate_screening", "detection_limit", "findings"])
def test_no_statistic_keeps_a_threshold_of_the_judgement(module: str) -> None:
    held = vars(importlib.import_module(f"estimators.misspecification.{module}"))
    thresholds = {name for name, value in held.items() if name.isupper() and isinstance(value, int | float)}
    assert thresholds <= {
        "_ROUNDING",
        "_THRESHOLD",
        "_TRIED",
        "_NEAR",
        "_LEAST",
        "_ROUNDS",
        "AT_ONCE",
        "_COLUMNS",
        "_UNSTABLE",
        "_MAINS_WITHIN",
    }  # of numbers, of searches, and of words


@pytest.mark.parametrize(
    "module",
    ["choice", "stepwise_selection", "removed_error", "verdict", "laboratory", "refitting", "simulation_selection"],
)
def test_no_module_of_the_diagnosis_keeps_a_threshold_of_its_judgement_to_itself(module: str) -> None:
    held = vars(importlib.import_module(f"estimators.diagnosis.{module}"))
    thresholds = {name for name, value in held.items() if name.isupper() and isinstance(value, int | float)}
    assert thresholds <= {"_QUIETER", "QUIET"}  # from where fits of the noise begin


def test_a_policy_says_in_what_it_differs() -> None:
    assert "the standard policy (version" in STANDARD.words
    assert "but for alarm = 30 (standard 20)" in dataclasses.replace(STANDARD, alarm=30.0).words


def test_the_alarm_of_a_policy_decides_which_candidate_is_tried() -> None:
    search = Known(known(base=-1000.0, cubic_spring=-900.0))
    findings = Findings((sized("cubic_spring", 25.0, 1e-9),))
    assert [s.id for s in improvements(search, search.base, findings, STANDARD)[0]] == ["cubic_spring"]
    for changed in ({"alarm": 30.0}, {"chance": 1e-10}):
        stricter = dataclasses.replace(STANDARD, **changed)
        assert improvements(search, search.base, findings, stricter)[0] == []


def test_the_policy_decides_what_the_data_can_show() -> None:
    spring = CubicSpring(2.0)
    found = Screened("cubic_spring", spring, ("stiffness",), np.zeros(1), 0.0, 1.0, np.array([50.0]), np.ones((3, 1)))
    assert is_testable(found, 50.0, STANDARD.testable)
    assert not is_testable(found, 50.0, 20.0)
    assert may_show(found, 50.0, STANDARD.testable)
    assert not may_show(found, 50.0, 20.0)


def test_what_may_be_gross_is_tried_beyond_its_plausible_size() -> None:
    """Where the arm's plane is vertical, and eccentric_moment several times what the model has."""
    tilt = GravityTilt(0.01, 0.01)
    found = Screened(
        "gravity_tilt", tilt, ("along", "across"), np.zeros(2), 0.0, 1.0, np.full(2, 0.302), np.ones((3, 2))
    )
    assert STANDARD.testable * 0.01 < 0.302
    assert may_show(found, 0.302, STANDARD.testable)
    assert not may_show(found, 11.0, STANDARD.testable)
    assert not is_testable(found, 0.302, STANDARD.testable), "no size that is told to be found from there on"


def test_the_level_of_a_policy_decides_what_rejects() -> None:
    findings = Findings(curves=(dataclasses.replace(force(50.0), p_value=1e-4),))
    assert adequacy_tests(findings, STANDARD.critical)[0].rejects
    assert not adequacy_tests(findings, dataclasses.replace(STANDARD, level=1e-5).critical)[0].rejects
