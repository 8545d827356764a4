"""Garbage collection is put off, and as it was afterwards."""

import gc

import pytest

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
