"""What surrounds the stages of an integration step: where it began, what comes to rest, and what happens at its end."""

from typing import Any

import jax.numpy as jnp

from rtac_jax._numbers import Number, State
from rtac_jax._rigid_body import RIGID_STATES
from rtac_jax._rtac import RTAC
from rtac_jax._since import Since, through
from rtac_jax._sincos import sincos
from rtac_jax._stopping import brought_to_rest
from rtac_jax.effects import Actuator, DryFriction, Impact, Motion
from rtac_jax.equations import friction_levels, mobility, own_states


def integrated(model: RTAC) -> list[int]:
    """Return the places of the states that are integrated, and do not follow in closed form from where a step began."""
    closed = [False] * len(RIGID_STATES) + [effect.closed for effect in model.effects for _ in effect.states]
    return [place for place, follows in enumerate(closed) if not follows]


def needs_beginning(model: RTAC) -> bool:
    """Return whether an effect needs to know where an integration step began, because it is not integrated itself."""
    return any(effect.closed or isinstance(effect, Impact) for effect in model.effects)


def beginning(model: RTAC, state: State, current: Number, step: Number, last: Number) -> Since:
    """Return the beginning of a step of this length [s], with the currents at its beginning and its end [A]."""
    motion = Motion(state[0], state[1], state[2], state[3], *sincos(state[2]), current, model.body)
    return Since(motion, step, last, 0.0)


def slide(model: RTAC, state: State) -> tuple[Any, Any]:
    """Return the directions in which cart and arm slide at the start of a step."""
    if not any(isinstance(effect, DryFriction) for effect in model.effects):
        return 0.0, 0.0
    return jnp.sign(state[1]), jnp.sign(state[3])


def stop(
    model: RTAC, before: State, after: State, current: Number, step: Number, arm_free: Number, cart_free: Number
) -> tuple[Any, ...]:
    """Return the state after a step, mended where cart or arm came to rest on the way or was at rest before.

    The step is taken with dry friction against the direction of its start; where that would turn the motion round,
    the step is cut at the instant of rest, after which the other forces, taken as constant, overcome the friction
    or do not. The cart is taken first, then the arm, and where both rub, again until they agree. So what slides
    has the accuracy of the Runge-Kutta step, a turn has second order, and what sticks does not move.

    Args:
        model: the rig.
        before: the state at the beginning of the step.
        after: at its end, by the integration.
        current: at its beginning [A].
        step: its length [s].
        arm_free: 1 where the arm may turn, 0 where it is locked.
        cart_free: 1 where the cart may move, 0 where it is clamped.

    Source: time stepping of Moreau (1988), with the step cut at the instant of rest.
    """
    levels = friction_levels(model, before, current)
    if not levels:
        return after
    return brought_to_rest(before, after, step, levels, mobility(model, sincos(before[2])[1], arm_free, cart_free))


def settle(model: RTAC, after: State, since: Since, arm_free: Number, cart_free: Number) -> tuple[Any, ...]:
    """Return the state after a step, with the states that have a closed form, and with what happens at once.

    Args:
        model: the rig.
        after: by the integration, with those states as they were at the beginning.
        since: the beginning of the step.
        arm_free: 1 where the arm may turn, 0 where it is locked.
        cart_free: 1 where the cart may move, 0 where it is clamped.
    """
    own = own_states(model, after)
    motion = since.seen_from(beginning(model, after, since.last, since.step, since.last).motion)
    rigid = list(after[:4])
    for effect in model.effects:
        if isinstance(effect, Actuator):
            before = own[effect.id]
            own[effect.id] = effect.follow(motion, before) if effect.closed else before
            motion = through(effect, motion, before, own[effect.id])
    for effect in model.effects:
        if isinstance(effect, Impact):
            _, cart_arm, arm_arm = mobility(model, motion.cos_angle, arm_free, cart_free)
            own[effect.id], impulse, moment = effect.strike(motion, own[effect.id], arm_arm)
            rigid[0], rigid[1] = rigid[0] + cart_arm * moment, rigid[1] + cart_arm * impulse
            rigid[2], rigid[3] = rigid[2] + arm_arm * moment, rigid[3] + arm_arm * impulse
    motion = motion._replace(**dict(zip(RIGID_STATES, rigid, strict=True)))
    for effect in model.effects:
        if effect.closed and not isinstance(effect, Actuator):
            own[effect.id] = effect.follow(motion, own[effect.id])
    return (*rigid, *(x for effect in model.effects for x in own[effect.id]))
