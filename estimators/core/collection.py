"""Garbage collection put off while many records are made."""

import contextlib
import gc
from collections.abc import Generator


@contextlib.contextmanager
def collected_later() -> Generator[None, None, None]:
    """Put off the search for unreachable cycles, which looks at all objects of the process, JAX's above all, again and again.

    For records by the thousand that are all kept; what is no longer referred to is freed as ever.
    """
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
