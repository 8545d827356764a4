"""Garbage collection put off while many objects are made."""

import contextlib
import gc
import threading
from collections.abc import Generator

_lock = threading.Lock()
_putting_off = 0
"""How many blocks run at this moment that were entered while collection was on, or off for the sake of others of these."""


@contextlib.contextmanager
def collected_later() -> Generator[None, None, None]:
    """Put off the search for unreachable cycles, which looks at all objects of the process, JAX's above all, again and again.

    It serves where objects are made by the thousand and all kept, as records and what tracing makes; what is no longer referred to
    is freed as ever. Where it was off already it stays off. Several threads may put it off at once.
    """
    global _putting_off
    with _lock:
        own = _putting_off > 0 or gc.isenabled()
        _putting_off += own
        if own:
            gc.disable()
    try:
        yield
    finally:
        with _lock:
            _putting_off -= own
            if own and not _putting_off:
                gc.enable()
