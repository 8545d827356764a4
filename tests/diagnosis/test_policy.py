"""A policy of one's own changes what is judged, and only that."""

import dataclasses

import pytest
from known_search import Known, known, screened

import estimators as est
from estimators.diagnosis.choice import chosen
from estimators.diagnosis.policy import STANDARD, DiagnosisPolicy
from estimators.diagnosis.stepwise_selection import improvements

GAINS = known(base=-1000.0, cubic_spring=-900.0, lvdt_lag=-903.0)


def step(policy: DiagnosisPolicy):
    search = Known(GAINS)
    search.policy = policy
    tried = {name: (screened(name), search.refit(name)) for name in ("cubic_spring", "lvdt_lag")}
    return chosen(search, search.refit(), tried)


def test_the_gain_that_is_asked_decides_whether_anything_is_chosen() -> None:
    found = step(STANDARD)
    assert found is not None
    assert found.id == "cubic_spring"
    assert step(dataclasses.replace(STANDARD, bic_gain=1000.0)) is None


def test_the_gain_within_which_rivals_count_decides_who_is_one() -> None:
    assert step(STANDARD).rivals == ("lvdt_lag",)
    strict = dataclasses.replace(STANDARD, bic_gain=1.0, vuong=0.0)
    assert step(strict).rivals == ()


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
def test_what_is_no_threshold_is_refused(wrong: dict[str, float], said: str) -> None:
    with pytest.raises(ValueError, match=said) as caught:
        est.DiagnosisPolicy(**wrong)
    assert next(iter(wrong)) in str(caught.value)


def test_no_module_of_the_diagnosis_keeps_a_threshold_of_its_judgement_to_itself() -> None:
    held = chosen.__globals__ | improvements.__globals__
    assert not {name for name, value in held.items() if name.isupper() and isinstance(value, int | float | tuple)} - {
        "ALARM"
    }
