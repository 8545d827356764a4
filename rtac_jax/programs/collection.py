"""Garbage collection put off while many objects are made."""

import contextlib
import gc
import threading
from collections.abc import Generator

_lock = threading.Lock()
_putting_off = 0  # by so many threads at this moment, where collection was on before the first


@contextlib.contextmanager
def collected_later() -> Generator[None, None, None]:
    """Put off the search for unreachable cycles, which looks at all objects of the process, JAX's above all, again and again.

    For records by the thousand that are all kept, and for tracing; what is no longer referred to is freed as ever. Where it was off
    already it stays off. Several threads may put it off at once.
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
