"""Active bounds: parameters that end on a bound are held there, as a reparametrisation only creeps towards it."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from estimators.core.fisher_information import information
from estimators.core.levenberg_marquardt import Arguments, Solved, factor, solve
from estimators.core.parameter_space import Space, Unknowns

_NEAR = 0.3  # standard deviations from its bound at which a parameter is held there
_TURNS = 4  # of holding and releasing, before what is left is taken as it is
_AT = 1e5  # unconstrained value that is as good as the bound


def solve_bounded(
    unknowns: Unknowns, arguments: Arguments, *, tolerance: float = 1e-6, most: int = 60, progress: object = None
) -> Solved:
    """Minimise the sum of squares as `solve` does, with parameters that run to a bound held on it.

    The factor of the result is that of all parameters, also of those held, so that their standard deviations are known.
    """
    whole = arguments.space
    held: dict[int, float] = {}
    turn = 0
    while True:
        turn += 1
        space, at = _holding(whole, unknowns, held)
        solved = solve(
            at, dataclasses.replace(arguments, space=space), tolerance=tolerance, most=most, progress=progress
        )
        unknowns = solved.unknowns
        full = np.asarray(factor(unknowns, dataclasses.replace(arguments, space=whole))) if held else solved.factor
        before = dict(held)
        held = _on_bounds(whole, unknowns, full, held)
        if held == before or turn == _TURNS:
            return solved._replace(factor=full)
        released = [place for place in before if place not in held]
        if released:
            inside = np.asarray(unknowns.shared).copy()
            inside[released] = 3.0 * np.sign(inside[released])
            unknowns = unknowns._replace(shared=jnp.asarray(inside))


def _holding(space: Space, unknowns: Unknowns, held: dict[int, float]) -> tuple[Space, Unknowns]:
    """Return the space without the free parameters in these places, which take the unconstrained values given."""
    if not held:
        return space, unknowns
    active = np.asarray(space.active).copy()
    shared = np.asarray(unknowns.shared).copy()
    values = np.asarray(space.values).copy()
    for place, end in held.items():
        bound = np.asarray(space.lower if end < 0 else space.upper)[active[place]]
        values[active[place]] = bound
        shared[place] = end
        active[place] = len(space.names)
    return (
        dataclasses.replace(space, active=jnp.asarray(active), values=jnp.asarray(values)),
        unknowns._replace(shared=jnp.asarray(shared)),
    )


def _on_bounds(space: Space, unknowns: Unknowns, full: np.ndarray, held: dict[int, float]) -> dict[int, float]:
    """Return the places of the free parameters that belong on a bound, and the unconstrained values that stand for it."""
    found = information(full, space, unknowns)
    deviations = np.sqrt(np.diagonal(found.covariance))
    shared = np.asarray(space.physical(unknowns)[0])
    gradient = full[:, :, : len(unknowns.shared)].transpose(0, 2, 1) @ full[:, :, -1:]
    downhill = -gradient.sum(axis=0)[:, 0]
    lower, upper = np.asarray(space.lower), np.asarray(space.upper)
    result = {}
    for place, index in enumerate(np.asarray(space.active)):
        if index >= len(space.names):
            continue
        value, low, high = shared[index], lower[index], upper[index]
        deviation = deviations[found.names.index(space.names[index])]
        if place in held:
            # It leaves the bound only if that lowers the cost by more than chance would.
            inward = downhill[place] * np.sign(-held[place]) > 0
            if not inward:
                result[place] = held[place]
        elif value - low < _NEAR * deviation and downhill[place] <= 0:
            result[place] = -_AT
        elif high - value < _NEAR * deviation and downhill[place] >= 0:
            result[place] = _AT
    return result
