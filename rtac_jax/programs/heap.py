"""Freed memory, given back to the operating system while a process goes on."""

import ctypes
import time
from collections.abc import Callable
from functools import cache

# Seconds between two times: a time takes some milliseconds for a gigabyte, in which other threads that allocate wait.
_INTERVAL = 1.0
_last = 0.0


def give_back() -> None:
    """Give freed memory back, now and then.

    The C library keeps what threads have freed for the thread that asks next, in many heaps: compilers and arrays of many
    megabytes leave a process of twice the size that it needs. Elsewhere than with glibc nothing is done.
    """
    global _last
    now = time.monotonic()
    if now - _last >= _INTERVAL and (trim := _trim()) is not None:
        _last = now
        trim(0)


@cache
def _trim() -> Callable[[int], int] | None:
    """Return what gives memory back; see malloc_trim(3)."""
    try:
        return ctypes.CDLL(None).malloc_trim
    except (OSError, AttributeError, TypeError):
        return None
