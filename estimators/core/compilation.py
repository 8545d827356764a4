"""Compilation ahead of time, and room for compiled code."""

import contextlib
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor, wait
from pathlib import Path

import jax

from rtac_jax.programs import forget_programs

_FRACTION = 0.5


class Ahead:
    """Code that another thread compiles piece by piece, in the order in which it will run."""

    def __init__(self, other: Executor, pieces: Sequence[Callable[[], None]]) -> None:
        self._left = [other.submit(piece) for piece in pieces]

    def next(self) -> None:
        """Wait for the next piece; what could not be compiled there is compiled where it runs."""
        with contextlib.suppress(IndexError):  # several threads may ask
            wait([self._left.pop(0)])


def compile_beside(piece: Callable[[], None]) -> None:
    """Compile a piece of code on another thread, and go on; whoever runs it waits for that, or compiles it where that failed."""
    pool = ThreadPoolExecutor(1)
    pool.submit(piece)
    pool.shutdown(wait=False)


def make_room(
    used: Path = Path("/proc/self/maps"),
    allowed: Path = Path("/proc/sys/vm/max_map_count"),
    fraction: float = _FRACTION,
) -> bool:
    """Drop compiled code if it takes up more than this fraction of the memory maps that Linux allows a process.

    Every model structure has code of its own, and a study of many of them in one process would end in a crash of the
    compiler. What is needed again comes back from the cache on disk. Only where nothing else computes.
    """
    try:
        maps, limit = used.read_bytes().count(b"\n"), int(allowed.read_text())
    except (OSError, ValueError):  # not Linux
        return False
    if maps <= fraction * limit:
        return False
    forget_programs()
    jax.clear_caches()
    return True
