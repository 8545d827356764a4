"""Freed memory goes back to the operating system."""

import os
import time
from pathlib import Path

import numpy as np
import pytest

from rtac_jax.programs import heap


def _resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.skipif(heap._trim() is None or not Path("/proc/self/statm").exists(), reason="not glibc on Linux")
def test_what_was_freed_is_given_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(heap, "_last", time.monotonic() + 3600)
    # Of a size that the C library keeps; the last of them, which stays, holds the end of the heap.
    held = [np.ones(8_000) for _ in range(3_000)]
    full = _resident()
    del held[:-1]
    heap.give_back()
    kept = _resident()
    assert full - kept < 20e6  # too soon after the last time: the C library keeps it
    monkeypatch.setattr(heap, "_last", -np.inf)
    heap.give_back()
    assert kept - _resident() > 150e6
    assert heap._last <= time.monotonic()
