"""Beginnings of experiments in which nothing tells the arm's angle: those on a circle from which a simulation follows best."""

import numpy as np
from jaxtyping import Bool

from estimators.core.initial_rest import squares
from estimators.core.initial_state import UNKNOWN_ANGLE
from estimators.core.jacobian_factor import Arguments
from estimators.core.parameter_space import Space, Unknowns
from rtac_jax.programs.arrays import to_jax

ANGLE = 2
"""The row of the arm's angle among the states at the start."""

CIRCLE = np.linspace(-np.pi, np.pi, 16, endpoint=False)
"""Angles from which experiments are tried [rad]. With eight, one of 80 experiments of 4 s began in a wrong basin."""

_BEST = 3  # minima on the circle from which a descent begins


def angle_unknown(space: Space) -> Bool[np.ndarray, " experiment"]:
    """Return whether neither an encoder nor `initial_arm_angle` tells an experiment's angle at the start."""
    spread, held = np.asarray(space.start_spread)[ANGLE], np.asarray(space.start_held)[ANGLE]
    # Where samples show a state nothing is known of it beforehand, and its spread is infinite.
    return np.isfinite(spread) & (spread >= UNKNOWN_ANGLE) & (held == 0)


def turned(unknowns: Unknowns, arguments: Arguments) -> list[Unknowns]:
    """Return the unknowns with the arm begun elsewhere in the experiments that do not tell its angle, the best first.

    An angle is taken from the minima around the circle of what the simulation leaves. Only angles at the start differ; empty
    where every experiment tells its own, or where starts are not among the unknowns.
    """
    space = arguments.space
    blind = angle_unknown(space)
    if not blind.any() or not len(unknowns.start):
        return []
    first, scale = np.asarray(space.start)[ANGLE], np.asarray(space.start_scale)[ANGLE]

    def begun(angles: np.ndarray) -> Unknowns:
        start = np.asarray(unknowns.start).copy()
        start[ANGLE] = np.where(blind, (angles - first) / scale, start[ANGLE])
        return unknowns._replace(start=to_jax(start))

    left = np.stack([squares(begun(np.full(len(blind), angle)), arguments) for angle in CIRCLE])
    lowest = (left <= np.roll(left, 1, axis=0)) & (left <= np.roll(left, -1, axis=0))
    order = np.argsort(np.where(lowest, left, np.inf), axis=0, kind="stable")
    minima = np.maximum(lowest.sum(axis=0), 1)
    return [begun(CIRCLE[order[np.minimum(n, minima - 1), np.arange(len(blind))]]) for n in range(_BEST)]
