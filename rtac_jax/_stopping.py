"""Dry friction over an integration step: the bodies that it brings to rest on the way, and those that it holds."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from rtac_jax._numbers import Number, State

# Cart and arm hand each other at most the square of their coupling, about 1 %, so three sweeps agree to 1e-6.
_SWEEPS = 3


def brought_to_rest(
    before: State,
    after: State,
    step: Number,
    levels: Sequence[tuple[Number, Number]],
    mobility: tuple[Number, Number, Number],
) -> tuple[Any, ...]:
    """Return the state after a step, mended where cart or arm came to rest; see `stop`.

    Args:
        before: state at the beginning of the step.
        after: state at its end, without rest.
        step: its length [s].
        levels: largest friction force on the cart and torque on the arm, of each effect.
        mobility: inverse of the mass matrix: cart by force, either by the other's, arm by torque.
    """
    cart_cart, cart_arm, arm_arm = mobility
    position, velocity, angle, arm_velocity, *rest = after
    rubs = tuple(any(not _never(pair[body]) for pair in levels) for body in (0, 1))
    most = tuple(step * own * sum(pair[i] for pair in levels) for i, own in enumerate((cart_cart, arm_arm)))
    by_cart, by_arm = _share(cart_arm, cart_cart), _share(cart_arm, arm_arm)  # what one's stop does to the other
    cart = arm = _Stop(0.0, 0.0, False)
    for _ in range(_SWEEPS if all(rubs) else 1):
        if rubs[0]:
            cart = _stopped(before[1], velocity + by_arm * arm.change, most[0])
        if rubs[1]:
            arm = _stopped(before[3], arm_velocity + by_cart * cart.change, most[1])
    position = position + step * (cart.shift + by_arm * arm.shift)
    angle = angle + step * (arm.shift + by_cart * cart.shift)
    velocity, arm_velocity = (
        velocity + cart.change + by_arm * arm.change,
        arm_velocity + arm.change + by_cart * cart.change,
    )
    if rubs[0]:
        position, velocity = jnp.where(cart.held, before[0], position), jnp.where(cart.held, 0.0, velocity)
    if rubs[1]:
        angle, arm_velocity = jnp.where(arm.held, before[2], angle), jnp.where(arm.held, 0.0, arm_velocity)
    return (position, velocity, angle, arm_velocity, *rest)


def _never(level: object) -> bool:
    return isinstance(level, float) and level == 0.0


class _Stop(NamedTuple):
    """The correction of a step of dry friction.

    Attributes:
        change: of the velocity.
        shift: of the position, divided by the step; both are zero for a step that slides all the way.
        held: whether the body was at rest before the step and stays so.
    """

    change: Any
    shift: Any
    held: Any


def _stopped(started: Number, arrived: Number, most: Number) -> _Stop:
    """Return the correction of a step of dry friction whose velocity vanishes, with other forces constant over it.

    Args:
        started: velocity before the step.
        arrived: velocity after it, with friction all the time against the direction of the start.
        most: largest change of the velocity by friction in a whole step.
    """
    way = jnp.where((started > 0) | ((started == 0) & (arrived > 0)), 1.0, -1.0)
    begin, end = way * started, way * arrived
    resting = started == 0
    driven = end - begin + jnp.where(resting, 0.0, most)  # by the other forces alone
    slides = end >= jnp.where(resting, most, 0.0)
    apart = most - driven
    rest = jnp.where(apart > 0, begin / jnp.where(apart > 0, apart, 1.0), 0.0)  # when it comes to rest, as a fraction
    back = jnp.minimum(driven + most, 0.0) * (1.0 - rest)
    late = jnp.where(resting, -most, 0.0)  # what slides off from rest was not yet rubbed
    change = jnp.where(slides, late, back - end)
    shift = jnp.where(slides, 0.5 * late, 0.5 * (rest * begin + (1.0 - rest) * back) - 0.5 * (begin + end))
    return _Stop(way * change, way * shift, resting & ~slides)


def _share(part: Number, whole: Number) -> Array:
    return jnp.where(whole > 0, part / jnp.where(whole > 0, whole, 1.0), 0.0)
