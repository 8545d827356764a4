"""What so few stretches of time could not confirm."""

import pytest

from estimators.diagnosis.policy import STANDARD
from estimators.misspecification.adequacy import unconfirmed
from estimators.misspecification.findings import Score


@pytest.mark.parametrize(
    ("stretches", "statistic", "few"), [(1, 500.0, False), (2, 500.0, True), (3, 500.0, True), (40, 500.0, False)]
)
def test_what_two_or_three_stretches_of_time_cannot_confirm_is_told(
    stretches: int, statistic: float, few: bool
) -> None:
    """One does not scatter, so nothing is asked of it; two scatter beyond any size."""
    several = [Score("arm_coulomb", 0, (), statistic, 0.03), Score("cogging", 0, (), 3.0, 0.5)]
    assert [s.id for s in unconfirmed(several, stretches, STANDARD.critical)] == ["arm_coulomb"] * few
    alarm = [*several, Score("cubic_spring", 0, (), 400.0, 1e-9)]
    assert unconfirmed(alarm, stretches, STANDARD.critical) == []
