"""Active bounds: parameters that end on a bound are held there, as a reparametrisation only creeps towards it."""

import dataclasses
from collections.abc import Iterable

import jax.numpy as jnp
import numpy as np

from estimators.core.bound_transform import to_unconstrained
from estimators.core.concentrated_noise import ConcentratedNoise
from estimators.core.fisher_information import each_deviations, each_slope, information, slope_of
from estimators.core.jacobian_factor import Arguments, Passes
from estimators.core.levenberg_marquardt import NEGLIGIBLE, Solved, solve
from estimators.core.parameter_space import Space, Unknowns
from estimators.core.progress import Tell

# Standard deviations from its bound at which a parameter is held there; no more of its plausible size, or what the data do not
# show, as the inertia of an arm beside a cart that friction holds, would be taken for nothing.
_NEAR = 0.3
_TURNS = 4  # of holding and releasing, before what is left is taken as it is
_FLAT = 0.01  # of the slope that it has amid its range, below which a parameter hardly moves though the data pull it
# How far inside a parameter begins again that the data pull off its bound, as fractions of its scale: where a straight line
# leads, but neither back to where its slope is lost, nor beyond a plausible size.
_INSIDE = (0.05, 1.0)
# Standard deviations inside, if that is less: from farther off a descent may not come back to what fine sensors tell from nothing.
# Set on one clean rig with encoders of 1e-6 of the motion, where 0.05 of the scale is a thousand deviations.
_BEYOND = 3.0
# Log-likelihood within which two values of one parameter are as good: half the 95 % quantile of chi-square of one degree.
_AS_GOOD = 1.92
# Unconstrained values that are as good as the bound, 1e-5 of the scale from a single one and 2e-9 of the width from one of two,
# and where the slope is still a number: a parameter without any would look as if nothing pulled it.
_AT_ONE, _AT_TWO = 1e5, 20.0
OFF_BOUNDS = 0.05
"""Fraction of its plausible size with which a parameter begins that is given exactly on a bound; the refits of a diagnosis begin
no nearer to null either."""


def solve_bounded(
    unknowns: Unknowns,
    arguments: Arguments,
    *,
    tolerance: float = 1e-6,
    gain: float = NEGLIGIBLE,
    most: int = 60,
    progress: Tell | None = None,
    noise: ConcentratedNoise | None = None,
    far: float = np.inf,
) -> Solved:
    """Minimise the sum of squares as `solve` does, with the same arguments; parameters that run to a bound are held on it.

    The factor of the result is that of all parameters, also of those held, so that their standard deviations are known.
    """
    whole = arguments.space
    held: dict[int, float] = {}
    before: dict[int, float] = {}
    best: Solved | None = None
    turn = 0
    while True:
        turn += 1
        space, at = _holding(whole, unknowns, held)
        within = dataclasses.replace(arguments, space=space)
        try:
            solved = solve(
                at, within, tolerance=tolerance, gain=gain, most=most, progress=progress, noise=noise, far=far
            )
        except FloatingPointError:
            if best is None:
                raise
            # A parameter taken off its bound makes the model diverge, as beside another that has run away.
            return best._replace(
                pulled=best.pulled or tuple(_names(whole, [place for place in before if place not in held]))
            )
        unknowns = solved.unknowns
        full = solved.factor
        if held:
            weights = None if noise is None else 1.0 / noise.deviations(solved.squares)
            full = Passes(arguments).factors(unknowns).joined(weights)
        before = dict(held)
        held, inside = _on_bounds(whole, unknowns, full, held)
        apart = _each_pulled(whole, unknowns, full)
        pulled = (*_names(whole, inside), *dict.fromkeys(whole.each[row] for row, _ in apart))
        solved = solved._replace(factor=full, pulled=pulled, held=len(before))
        if best is None or solved.cost <= best.cost:
            best = solved
        elif best.pulled and not solved.pulled and solved.cost < best.cost + _AS_GOOD:
            best = best._replace(pulled=())  # it was released, and inside nothing is better
        if (held == before and not inside and not apart) or turn == _TURNS:
            return best
        shared = np.asarray(unknowns.shared).copy()
        released = [place for place in before if place not in held]
        shared[released] = 3.0 * np.sign(shared[released])
        for place, value in inside.items():
            shared[place] = value
        each = np.asarray(unknowns.each).copy()
        for where, value in apart.items():
            each[where] = value
        unknowns = unknowns._replace(shared=jnp.asarray(shared), each=jnp.asarray(each))


def _names(space: Space, places: Iterable[int]) -> list[str]:
    """Return the names of free parameters by their places."""
    return [space.names[int(space.active[place])] for place in dict.fromkeys(places)]


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
        value, low, high = (float(x[index]) for x in (shared, lower, upper))
        deviation = float(deviations[found.names.index(space.names[index])])
        near = _NEAR * min(deviation, float(scale[index]))
        if place in held:
            # It leaves the bound only if that lowers the cost by more than chance would.
            inward = downhill[place] * np.sign(-held[place]) > 0
            if not inward:
                result[place] = held[place]
        elif value - low < near and downhill[place] <= 0:
            result[place] = -_end(low, high)
        elif high - value < near and downhill[place] >= 0:
            result[place] = _end(low, high)
        else:
            # Where it would go with all others following, by a straight line in physical units.
            move = float(downhill[place] / slope[place]) * deviation**2
            begin = _released(value, (low, high), float(scale[index]), float(slope[place]), move, deviation)
            if begin is not None:
                inside[place] = begin
    return result, inside


def _each_pulled(space: Space, unknowns: Unknowns, full: np.ndarray) -> dict[tuple[int, int], float]:
    """Return the parameters of single experiments on a bound that the data pull inwards, by place, with one inside to go on from.

    They are not held on their bounds: a creep there costs nothing, as what each experiment has for itself is eliminated.
    """
    if not space.each:
        return {}
    values = np.asarray(space.physical(unknowns)[1])
    slope, deviation = each_slope(space, unknowns), each_deviations(full, space, unknowns)
    first = len(unknowns.shared)
    downhill = -np.einsum("bre,br->eb", full[:, :, first : first + len(space.each)], full[:, :, -1])
    move = downhill / slope * deviation**2
    result = {}
    for row, column in np.ndindex(values.shape):
        bounds = float(space.each_lower[row]), float(space.each_upper[row])
        at = (row, column)
        here = (float(x[at]) for x in (slope, move, deviation))
        begin = _released(float(values[at]), bounds, float(space.each_scale[row]), *here)
        if begin is not None:
            result[at] = begin
    return result


def _released(
    value: float, bounds: tuple[float, float], scale: float, slope: float, move: float, deviation: float
) -> float | None:
    """Return the unconstrained value inside from which a parameter goes on that the data pull off its bound; else None.

    Args:
        value: where the parameter is, in physical units.
        bounds: lower and upper, infinite where there is none.
        scale: size of the parameter.
        slope: of the value by its unconstrained stand-in.
        move: where a straight line leads from here, in physical units.
        deviation: standard deviation of the value.
    """
    low, high = bounds
    if not (np.isfinite(low) or np.isfinite(high)):
        return None
    width = high - low
    amid = 0.25 * width if np.isfinite(width) else scale
    inward = move if value - low < high - value else -move
    if slope >= _FLAT * amid or inward <= _NEAR * deviation:
        return None
    least, most = (fraction * scale for fraction in _INSIDE)
    by = min(max(inward, min(least, _BEYOND * deviation)), most, 0.5 * width)
    target = low + by if value - low < high - value else high - by
    return float(to_unconstrained(*(np.asarray(x) for x in (target, low, high, scale))))


def _end(low: float, high: float) -> float:
    """Return the unconstrained value that stands for the upper bound, and less it for the lower one."""
    return _AT_TWO if np.isfinite(low) and np.isfinite(high) else _AT_ONE
