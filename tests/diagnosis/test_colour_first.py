"""Coloured noise without rest records is asked for after the first effect, not only when a search beside white noise has ended."""

import pytest
from known_search import TRAITS, Known, known, screened

from estimators.diagnosis.evidence import Facts, FittedModel
from estimators.diagnosis.policy import STANDARD
from estimators.diagnosis.stepwise_selection import select
from estimators.misspecification.findings import Findings

_FIRST = 300.0  # log-likelihood that the first effect gains
_ALL = {"cubic_spring": _FIRST, "cubic_spring__lvdt_lag": 1.5 * _FIRST}


class _WithoutRest(Known):
    """A laboratory without rest records, in which coloured noise gains so much and leaves nothing."""

    def __init__(self, gained: float) -> None:
        super().__init__(known(base=0.0, **_ALL))
        self.facts = Facts(
            10_000, 2, 2, rest=False, noise_known=False, samples_per_radian=20.0, effects=TRAITS, unfollowed=0.0
        )
        self._with_colour = self.model()
        self._with_colour = FittedModel(**{**vars(self._with_colour), "log_likelihood": gained})
        self.asked: list[str] = []
        self.rejects = self._rejects

    def _rejects(self, model: FittedModel) -> Findings:
        if model.number == self._with_colour.number:
            return Findings()
        return Findings(scores=tuple(screened(e) for e in ("cubic_spring", "lvdt_lag") if e not in model.added))

    def coloured(self, beside: FittedModel) -> FittedModel | None:
        self.asked.append(" + ".join(beside.added))
        return self._with_colour


@pytest.mark.parametrize(("times", "first"), [(2.5, True), (1.7, False)])
def test_no_second_effect_is_looked_for_where_colour_gains_as_much_as_two_would(times: float, first: bool) -> None:
    laboratory = _WithoutRest(times * _FIRST)
    found = select(laboratory, STANDARD, thorough=False)
    assert found.base.log_likelihood == times * _FIRST  # colour beats both effects in the end, too
    assert laboratory.asked == ["cubic_spring"] + (not first) * ["cubic_spring + lvdt_lag"]


def test_where_the_first_effect_explains_all_it_is_not_asked_beside_it() -> None:
    laboratory = _WithoutRest(0.8 * _FIRST)
    laboratory.rejects = lambda model: Findings(scores=() if model.added else (screened("cubic_spring"),))
    assert [step.id for step in select(laboratory, STANDARD, thorough=False).steps] == ["cubic_spring"]
    assert laboratory.asked == ["cubic_spring"]  # in the end only, as before


def test_colour_that_gains_less_than_the_effects_is_not_taken() -> None:
    found = select(_WithoutRest(1.2 * _FIRST), STANDARD, thorough=False)
    assert [step.id for step in found.steps] == ["cubic_spring", "lvdt_lag"]
