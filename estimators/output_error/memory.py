"""The memory that a fit takes, said before it begins, and refused where there is not that much."""

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path

from estimators.core.piecewise_triangle import LONG, MANY
from estimators.core.results import TooLargeError
from rtac_jax import RTAC
from rtac_jax.effects import Input
from rtac_jax.excitation import BEYOND
from rtac_jax.measurement import Experiment
from rtac_jax.time_loop import room_for

# Numbers that are held of each sample: measurements and inputs, what a simulation and a filter return, and their copies; for
# each state the gains of two predictions. Counted, and held against one fit of 100,000 samples, which took 0.35 GB in all.
_OF_SAMPLE, _OF_STATE = 45, 7
# Where sensitivities are kept whole: three outputs, and copies while they are compressed.
_OF_DIRECTION = 12
_COMPILER = 500_000_000  # bytes that compiling and its results take, whatever the recording
_FRACTION = 0.25
"""Fraction of the memory that is free from which on a fit says what it takes."""
_SAID = 1_000_000_000  # bytes from which on it does wherever that much is free


def bytes_needed(model: RTAC, experiments: Sequence[Experiment]) -> int:
    """Return about how many bytes a fit of a model to these experiments takes beside what is in memory already."""
    room = room_for(max(e.samples for e in experiments) + BEYOND)
    states = len(model.states)
    numbers = _OF_SAMPLE + _OF_STATE * states
    cut = room >= LONG or room * len(experiments) >= MANY
    if not cut or any(isinstance(effect, Input) for effect in model.effects):
        numbers += _OF_DIRECTION * (len(model.free) + states + 1)
    return 8 * numbers * room * len(experiments) + _COMPILER


def bytes_free() -> int | None:
    """Return how many bytes this process may still take: of the machine, of its container and of its limit; None if unknown."""
    found = []
    with contextlib.suppress(OSError, ValueError, IndexError):
        lines = Path("/proc/meminfo").read_text().splitlines()
        found.append(1024 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable")))
    with contextlib.suppress(OSError, ValueError):
        allowed = int(Path("/sys/fs/cgroup/memory.max").read_text())  # "max" is no number, and no limit
        found.append(allowed - int(Path("/sys/fs/cgroup/memory.current").read_text()))
    with contextlib.suppress(ImportError, OSError, ValueError, IndexError):
        import resource  # not on Windows

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            found.append(limit - pages * os.sysconf("SC_PAGE_SIZE"))
    return max(min(found), 0) if found else None


def require_memory(model: RTAC, experiments: Sequence[Experiment]) -> str:
    """Return a sentence about what a fit will take where that is much; empty where it is not.

    Raises:
        TooLargeError: it is more than there is.
    """
    free = bytes_free()
    needed = bytes_needed(model, experiments)
    if free is None or needed < min(_FRACTION * free, _SAID):
        return ""
    samples = sum(e.samples for e in experiments)
    said = f"{samples:,} samples in {len(experiments)} experiment(s) take about {needed / 1e9:.2g} GB"
    if needed > free:
        raise TooLargeError(
            f"{said}, and {free / 1e9:.2g} GB are free; fit fewer experiments (Recording.select), shorter ones "
            "(Experiment.cut), or every n-th sample."
        )
    return f"{said} of the {free / 1e9:.2g} GB that are free."
