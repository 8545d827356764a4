"""The time that optional work is given, and how it is shared between looking for what is missing and adding it."""

import pytest

from estimators.core.deadline import PROLONGED, SEARCHING, Deadline


def test_searching_and_what_comes_after_it_take_the_time_that_was_given() -> None:
    deadline = Deadline.of_searching(100.0)
    assert deadline.seconds == SEARCHING * 100.0
    assert deadline.prolonged(PROLONGED).left == pytest.approx(100.0, abs=1.0)
    # A search within a search ends with it, and what comes after that ends with what comes after this one.
    inner = Deadline.of_searching(deadline.within)
    assert inner.left == pytest.approx(deadline.left, abs=1.0)
    assert inner.prolonged(PROLONGED).left <= deadline.prolonged(PROLONGED).left + 1e-6


def test_without_an_end_no_time_is_over() -> None:
    assert Deadline.of_searching(None).left == float("inf")
    assert not Deadline.of_searching(None).over
    assert Deadline.of_searching(0.0).over
