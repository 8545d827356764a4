"""Active bounds: parameters that end on a bound are held there, as a reparametrisation only creeps towards it."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from estimators.core.bound_transform import to_unconstrained
from estimators.core.fisher_information import information, slope_of
from estimators.core.levenberg_marquardt import Arguments, Solved, factor, solve
from estimators.core.parameter_space import Space, Unknowns

_NEAR = 0.3  # standard deviations from its bound at which a parameter is held there
_TURNS = 4  # of holding and releasing, before what is left is taken as it is
_FLAT = 0.01  # of the slope that it has amid its range, below which a parameter hardly moves though the data pull it
# How far inside a parameter begins again that the data pull off its bound, as shares of its scale: where a straight line
# leads, but neither back to where its slope is lost, nor beyond a plausible size.
_INSIDE = (0.05, 1.0)
_AT = 1e5  # unconstrained value that is as good as the bound


def solve_bounded(
    unknowns: Unknowns, arguments: Arguments, *, tolerance: float = 1e-6, most: int = 60, progress: object = None
) -> Solved:
    """Minimise the sum of squares as `solve` does, with parameters that run to a bound held on it.

    The factor of the result is that of all parameters, also of those held, so that their standard deviations are known.
    """
    whole = arguments.space
    held: dict[int, float] = {}
    best: Solved | None = None
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
        held, inside = _on_bounds(whole, unknowns, full, held)
        solved = solved._replace(factor=full, pulled=bool(inside))
        if best is None or solved.cost <= best.cost:
            best = solved
        if (held == before and not inside) or turn == _TURNS:
            return best
        shared = np.asarray(unknowns.shared).copy()
        released = [place for place in before if place not in held]
        shared[released] = 3.0 * np.sign(shared[released])
        for place, value in inside.items():
            shared[place] = value
        unknowns = unknowns._replace(shared=jnp.asarray(shared))


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


def _on_bounds(
    space: Space, unknowns: Unknowns, full: np.ndarray, held: dict[int, float]
) -> tuple[dict[int, float], dict[int, float]]:
    """Return the free parameters that belong on a bound, and those on one that the data pull inwards.

    Both by place: the first with the unconstrained value that stands for the bound, the second with one inside to go on from.
    That they are pulled is the sign of Karush, Kuhn and Tucker: the physical gradient at the bound points inwards. By how much
    is counted with all other parameters following, so that what leads less than `_NEAR` deviations away is left there.
    """
    found = information(full, space, unknowns)
    deviations = np.sqrt(np.diagonal(found.covariance))
    shared = np.asarray(space.physical(unknowns)[0])
    gradient = full[:, :, : len(unknowns.shared)].transpose(0, 2, 1) @ full[:, :, -1:]
    downhill = -gradient.sum(axis=0)[:, 0]
    lower, upper, scale = np.asarray(space.lower), np.asarray(space.upper), np.asarray(space.scale)
    slope = slope_of(space, unknowns)
    result, inside = {}, {}
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
        elif np.isfinite(low) or np.isfinite(high):
            width = high - low
            amid = 0.25 * width if np.isfinite(width) else scale[index]
            # Where it would go with all others following, by a straight line in physical units.
            move = downhill[place] / slope[place] * deviation**2
            inward = move if value - low < high - value else -move
            if abs(slope[place]) < _FLAT * amid and inward > _NEAR * deviation:
                by = min(np.clip(inward, *(share * scale[index] for share in _INSIDE)), 0.5 * width)
                target = low + by if value - low < high - value else high - by
                inside[place] = float(to_unconstrained(*(np.asarray(x) for x in (target, low, high, scale[index]))))
    return result, inside
