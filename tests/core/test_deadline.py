"""A deadline: optional work breaks off once it is over, on whichever thread, and nobody else's does."""

import math
import threading

import pytest

from estimators.core.deadline import PROLONGED, SEARCHING, Deadline, OutOfTimeError, require_time, with_deadline
from estimators.core.threads import at_once


def test_without_a_deadline_there_is_time():
    require_time()
    assert Deadline().left == math.inf
    with Deadline().kept():
        require_time()


def test_after_the_deadline_no_step_begins_and_it_is_known_that_one_was_asked():
    deadline = Deadline(0.0)
    assert deadline.over
    with deadline.kept():
        assert not deadline.missed
        with pytest.raises(OutOfTimeError):
            require_time()
    assert deadline.missed
    require_time()  # beyond what keeps it


def test_who_prolongs_it_has_a_fraction_more():
    deadline = Deadline(30.0)
    assert deadline.prolonged(0.5).left == pytest.approx(45.0, abs=1.0)
    assert Deadline().prolonged(0.5).left == math.inf


def test_the_innermost_holds():
    with Deadline(0.0).kept(), Deadline().kept():
        require_time()


def test_threads_that_are_asked_keep_it_and_others_do_not():
    def late(_):
        try:
            require_time()
        except OutOfTimeError:
            return threading.get_ident()
        return None

    with Deadline(0.0).kept():
        found = at_once(late, range(8))
        assert all(found)
        assert set(found) != {threading.get_ident()}
        kept, other = [], []
        threads = [
            threading.Thread(target=lambda: other.append(late(0))),
            threading.Thread(target=with_deadline(lambda: kept.append(late(0)))),
        ]
        for thread in threads:
            thread.start()
            thread.join()
    assert other == [None]
    assert kept[0] is not None


def test_searching_and_what_comes_after_it_take_the_time_that_was_given() -> None:
    deadline = Deadline.of_searching(100.0)
    assert deadline.seconds == SEARCHING * 100.0
    assert deadline.prolonged(PROLONGED).left == pytest.approx(100.0, abs=1.0)
    # A search within a search ends with it, and what comes after that ends with what comes after this one.
    inner = Deadline.of_searching(deadline.within)
    assert inner.left == pytest.approx(deadline.left, abs=1.0)
    whole = deadline.prolonged(PROLONGED).left  # read first: what is left only falls
    assert inner.prolonged(PROLONGED).left <= whole + 1e-6


def test_without_an_end_no_time_is_over() -> None:
    assert Deadline.of_searching(None).left == float("inf")
    assert not Deadline.of_searching(None).over
    assert Deadline.of_searching(0.0).over
