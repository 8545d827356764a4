"""What is said of a nominal model that has a mode too many."""

import control as ct
import pytest

from estimators.reporting.envelope import cancelled_modes

RIG = ct.tf([1.0], [1.0, 0.5, 108.0])


@pytest.mark.parametrize(("zero", "named"), [(5.6, True), (3.0, False)])
def test_a_mode_that_zeros_cancel_is_named(zero: float, named: bool) -> None:
    extra = ct.tf([1.0, 2.8, zero**2 + 2.0], [1.0, 3.2, 5.97**2])
    said = cancelled_modes(RIG * extra)
    assert bool(said) is named
    assert not named or "P0's mode at 5.97 rad/s is all but cancelled" in said[0]
    assert not named or "An order of 2 does without it" in said[0]
    assert cancelled_modes(RIG) == []
