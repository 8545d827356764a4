"""Initial states at rest, where the first samples do not show the state."""

import numpy as np
from jaxtyping import Float

from estimators.core.jacobian_factor import Arguments, plain_residual
from estimators.core.parameter_space import Space, Unknowns
from rtac_jax import RTAC
from rtac_jax.programs.arrays import to_jax

_SPEEDS = (1, 3)  # rows of the cart's and the arm's


def at_rest(unknowns: Unknowns, space: Space) -> Unknowns:
    """Return the unknowns with cart and arm at rest, and the effects' states at equilibrium.

    Most experiments begin so, and a tachometer that swings, as a rotor behind a soft shaft or within a play does, makes its
    first samples say otherwise.
    """
    start = np.asarray(unknowns.start).copy()
    if len(start) == 0:
        return unknowns
    rows = [*_SPEEDS, *range(4, len(start))]
    start[rows] = -(np.asarray(space.start) / np.asarray(space.start_scale))[rows]
    return unknowns._replace(start=to_jax(start))


def may_swing(model: RTAC) -> bool:
    """Return whether something in the model could move beside cart and arm, so that first samples may mislead."""
    return any(effect.states for effect in model.effects)


def best_starts(several: list[Unknowns], arguments: Arguments, *, worth: float = 1.0) -> Unknowns:
    """Return the first unknowns, with the starts of others where these fit better.

    Another one is taken for those experiments alone in which it leaves less than this fraction (`worth`) of what the
    first leaves.
    """
    left = np.stack([squares(one, arguments) for one in several])
    left[1:] /= worth
    best = np.argmin(left, axis=0)
    if not best.any():
        return several[0]
    parts = [np.stack([np.asarray(one[field]) for one in several]) for field in (1, 2)]
    each, start = (np.take_along_axis(part, best[None, None], axis=0)[0] for part in parts)
    return several[0]._replace(each=to_jax(each), start=to_jax(start))


def squares(unknowns: Unknowns, arguments: Arguments) -> Float[np.ndarray, " experiment"]:
    """Return the sum of squares that a simulation leaves of each experiment, in units of the noise; infinite if it diverges."""
    error, known = (np.asarray(part) for part in plain_residual(unknowns, arguments))
    with np.errstate(over="ignore"):  # what diverges is infinite then
        found = np.sum(error**2, axis=(0, 1)) + np.sum(known**2, axis=0)
    return np.where(np.isfinite(found), found, np.inf)
