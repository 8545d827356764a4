"""The search of where experiments begin, the parameters given."""

import contextlib
import dataclasses
from collections.abc import Iterator

import numpy as np

from estimators.core.active_bounds import solve_bounded
from estimators.core.initial_angle import turned
from estimators.core.initial_rest import at_rest, best_starts, may_swing, squares
from estimators.core.jacobian_factor import Arguments
from estimators.core.parameter_space import Unknowns

_NOISE = 1.2  # mean square of an error over its noise, from which on a start is sought elsewhere
# Parts of the data that are followed first, from whose starts one of the next, longer part is sought. Over a long one alone an
# arm that turns over has many best starts: of 36 experiments in which it does the true model left 19 at 68 to 38,000 times the
# noise without these, and leaves one so with them.
_PARTS = (64, 16, 4, 2)
_SHORTEST = 16  # samples that may show a start


def searched(unknowns: Unknowns, arguments: Arguments) -> Unknowns | None:
    """Return the start from which the simulation follows the measurements best; None where it diverges from every one.

    It is sought from the first samples, over ever longer parts. Where that leaves more than noise of an experiment, it is sought
    from other angles of an arm whose angle nobody tells. Where something may swing beside cart and arm it is sought from rest,
    too: a state that the first samples do not show, as the speed of an arm behind a soft shaft, adds up to turns of the arm, from
    where no small step leads back. So it is wherever a simulation from rest, as it is, already follows better than what was found.
    """
    best: Unknowns | None = None
    for begin in _beginnings(unknowns, arguments):
        best = _better(best, begin, arguments)
        if best is not None and not np.any(beyond_noise(best, arguments)):
            return best
    rest = at_rest(unknowns, arguments.space)
    if best is None or np.any(squares(rest, arguments) < squares(best, arguments)):
        return _better(best, rest if best is None else best_starts([best, rest], arguments), arguments)
    return best


def _better(best: Unknowns | None, begin: Unknowns, arguments: Arguments) -> Unknowns | None:
    """Return the best start so far, with those of experiments that a search from this beginning follows better."""
    with contextlib.suppress(FloatingPointError):
        found = solve_bounded(begin, arguments, tolerance=1e-5, most=40).unknowns
        return found if best is None else best_starts([best, found], arguments)
    return best


def beyond_noise(unknowns: Unknowns, arguments: Arguments) -> np.ndarray:
    """Return in which experiments the simulation leaves more than noise [experiment]."""
    return squares(unknowns, arguments) >= _NOISE * np.asarray(arguments.data.present).sum(axis=(0, 1))


def _beginnings(unknowns: Unknowns, arguments: Arguments) -> Iterator[Unknowns]:
    yield _led(unknowns, arguments)
    yield from turned(unknowns, arguments)
    if may_swing(arguments.model):
        yield at_rest(unknowns, arguments.space)


def _led(unknowns: Unknowns, arguments: Arguments) -> Unknowns:
    """Return where ever longer parts of the data lead a start that leaves more than noise, from there or from rest."""
    if not np.any(beyond_noise(unknowns, arguments)):
        return unknowns
    first, rest = unknowns, at_rest(unknowns, arguments.space)
    for part in _PARTS:
        data = arguments.data.beginning(max(arguments.data.samples // part, _SHORTEST))
        within = dataclasses.replace(arguments, data=data)
        try:
            unknowns = solve_bounded(best_starts([unknowns, rest], within), within, tolerance=1e-3, most=10).unknowns
        except FloatingPointError:
            break
    return best_starts([unknowns, first], arguments)
