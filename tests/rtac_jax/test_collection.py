"""Garbage collection is put off, and as it was afterwards."""

import gc
import threading

import numpy as np
import pytest

from rtac_jax.programs import program
from rtac_jax.programs.collection import collected_later


def test_it_is_off_within_and_as_it_was_after():
    assert gc.isenabled()
    with collected_later():
        assert not gc.isenabled()
        with collected_later():
            assert not gc.isenabled()
        assert not gc.isenabled()
    assert gc.isenabled()


def test_an_error_leaves_it_on():
    with pytest.raises(ValueError, match="lost"), collected_later():
        raise ValueError("lost")
    assert gc.isenabled()


def test_of_two_threads_the_first_to_leave_does_not_turn_it_on():
    entered, left = threading.Event(), threading.Event()
    seen = []

    def other():
        with collected_later():
            entered.set()
            left.wait(10)
            seen.append(gc.isenabled())

    thread = threading.Thread(target=other)
    with collected_later():
        thread.start()
        assert entered.wait(10)
    assert not gc.isenabled()
    left.set()
    thread.join()
    assert seen == [False]
    assert gc.isenabled()


def test_where_it_is_off_already_it_stays_off():
    gc.disable()
    try:
        with collected_later():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_it_is_off_while_a_program_is_traced():
    seen = []

    def traced(x):
        seen.append(gc.isenabled())
        return 2 * x

    assert float(program(traced)(np.ones(()))) == 2.0
    assert seen == [False]
    assert gc.isenabled()
