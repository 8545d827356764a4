"""A second look ends where what follows its first step is known."""

import dataclasses

import pytest

from estimators.diagnosis.evidence import FittedModel
from estimators.diagnosis.policy import STANDARD
from estimators.diagnosis.step import Step
from estimators.diagnosis.stepwise_selection import _Look

KNOWN = Step("cubic_spring", (), 100.0, 90.0, 90.0, FittedModel(1, ("cubic_spring",), 1, 0.0), ())


@pytest.mark.parametrize(
    ("step", "repeats"),
    [
        (KNOWN, True),
        (dataclasses.replace(KNOWN, gain=KNOWN.gain + STANDARD.bic_gain), True),
        (dataclasses.replace(KNOWN, gain=KNOWN.gain + STANDARD.bic_gain + 0.1), False),  # a better optimum
        (dataclasses.replace(KNOWN, id="lvdt_lag"), False),
    ],
)
def test_what_follows_the_same_first_step_is_known(step: Step, repeats: bool) -> None:
    assert _Look([], [], "thorough", known=KNOWN).repeats(step, STANDARD) is repeats
    assert not _Look([], [], "thorough").repeats(step, STANDARD)
