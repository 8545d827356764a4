"""The search of where experiments begin, the parameters given."""

import contextlib
from collections.abc import Iterator

import numpy as np

from estimators.core.active_bounds import solve_bounded
from estimators.core.initial_angle import turned
from estimators.core.initial_rest import at_rest, best_starts, may_swing, squares
from estimators.core.jacobian_factor import Arguments
from estimators.core.parameter_space import Unknowns

_NOISE = 1.2  # mean square of an error over its noise, from which on a start is sought elsewhere


def searched(unknowns: Unknowns, arguments: Arguments) -> Unknowns | None:
    """Return the start from which the simulation follows the measurements best; None where it diverges from every one.

    It is sought from the first samples. Where that leaves more than noise of an experiment, it is sought from other angles of an
    arm whose angle nobody tells. Where something may swing beside cart and arm it is sought from rest, too: a state that the
    first samples do not show, as the speed of an arm behind a soft shaft, adds up to turns of the arm, from where no small step
    leads back.
    """
    best: Unknowns | None = None
    for begin in _beginnings(unknowns, arguments):
        with contextlib.suppress(FloatingPointError):
            found = solve_bounded(begin, arguments, tolerance=1e-5, most=40).unknowns
            best = found if best is None else best_starts([best, found], arguments)
            if not np.any(beyond_noise(best, arguments)):
                break
    return best


def beyond_noise(unknowns: Unknowns, arguments: Arguments) -> np.ndarray:
    """Return in which experiments the simulation leaves more than noise [experiment]."""
    return squares(unknowns, arguments) >= _NOISE * np.asarray(arguments.data.present).sum(axis=(0, 1))


def _beginnings(unknowns: Unknowns, arguments: Arguments) -> Iterator[Unknowns]:
    yield unknowns
    yield from turned(unknowns, arguments)
    if may_swing(arguments.model):
        yield at_rest(unknowns, arguments.space)
