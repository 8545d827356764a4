"""The equations of motion of a rigid body with effects: from state and inputs to rates and outputs."""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Array

from rtac_jax._numbers import Number, State
from rtac_jax._rigid_body import RIGID_STATES
from rtac_jax._rtac import RTAC
from rtac_jax._since import Since, through
from rtac_jax._sincos import sincos
from rtac_jax.effects import Actuator, DryFriction, Effect, Force, Input, Motion, Outputs, Sensor
from rtac_jax.effects._interface import in_parts
from rtac_jax.excitation import Excitation

_PORTS = ("on the cart", "on the arm")


def derivative(
    model: RTAC,
    state: State,
    current: Number,
    force: Number,
    arm_free: Number = 1.0,
    cart_free: Number = 1.0,
    way: tuple[Number, Number] = (0.0, 0.0),
    since: Since | None = None,
) -> tuple[Any, ...]:
    """Return the time derivative of the state: equations (1) and (2) with the effects.

    Args:
        model: the rig.
        state: one array per state; all of one shape.
        current: motor current [A].
        force: disturbance force F on the cart [N].
        arm_free: 1 where the arm may turn, 0 where it is locked.
        cart_free: 1 where the cart may move, 0 where it is clamped.
        way: direction in which cart and arm slide, 1 or -1, against which dry friction acts; 0 for none.
        since: the beginning of the integration step; from there states with a closed form are followed, so that
            `state` holds their values at the beginning and their derivatives are zero. None: all are integrated.
    """
    position, velocity, angle, arm_velocity, *_ = state
    sine, cosine = sincos(angle)
    body = model.body
    own = own_states(model, state)
    rates: dict[str, tuple[Any, ...]] = {}
    motion = Motion(position, velocity, angle, arm_velocity, sine, cosine, current, body, force=force)
    if since is not None:
        motion = since.seen_from(motion)

    def act(effect: Effect) -> tuple[Any, ...]:
        """Return the rates of an effect; its states are brought to this instant."""
        if not effect.closed or since is None:
            return in_parts(effect.rate(motion, own[effect.id]), effect, "rate", tuple(effect.states))
        if not isinstance(effect, Sensor):
            own[effect.id] = effect.during(motion, own[effect.id])
        return (0.0 * position,) * len(effect.states)

    for effect in model.effects:
        if isinstance(effect, Actuator):
            before = own[effect.id]
            rates[effect.id] = act(effect)
            motion = through(effect, motion, before, own[effect.id])

    cart = force - body.spring_stiffness * position + body.eccentric_moment * arm_velocity**2 * sine
    arm = body.torque_constant * motion.current
    for effect in model.effects:
        if not isinstance(effect, (Actuator, Sensor)):
            rates[effect.id] = act(effect)
        if isinstance(effect, Force):
            on_cart, on_arm = in_parts(effect.force(motion, own[effect.id]), effect, "force", _PORTS)
            cart, arm = cart + on_cart, arm + on_arm
        elif isinstance(effect, DryFriction):
            on_cart, on_arm = in_parts(effect.levels(motion, own[effect.id]), effect, "levels", _PORTS)
            cart, arm = cart - way[0] * on_cart, arm - way[1] * on_arm

    cart_cart, cart_arm, arm_arm = mobility(model, cosine, arm_free, cart_free)
    result = (velocity, cart_cart * cart + cart_arm * arm, arm_velocity, cart_arm * cart + arm_arm * arm)
    motion = motion._replace(cart_acceleration=result[1], arm_acceleration=result[3])
    for effect in model.effects:
        if isinstance(effect, Sensor):
            rates[effect.id] = act(effect)
        result += rates[effect.id]
    return result


def mobility(model: RTAC, cosine: Number, arm_free: Number, cart_free: Number) -> tuple[Any, Any, Any]:
    """Return the inverse of the mass matrix: accelerations by a unit force and a unit torque.

    Returns:
        The cart's by the force [1/kg], either body's by what acts on the other [1/(kg m)], the arm's by the torque [1/(kg m^2)].
    """
    body = model.body
    mass, inertia = body.total_mass, body.arm_inertia
    for effect in model.effects:
        if isinstance(effect, Force):
            mass, inertia = mass + effect.cart_mass(), inertia + effect.arm_inertia(body)
    exchange = body.eccentric_moment * cosine * (arm_free * cart_free)
    scale = 1.0 / (mass * inertia - exchange * exchange)
    return cart_free * scale * inertia, -scale * exchange, arm_free * scale * mass


def friction_levels(model: RTAC, state: State, current: Number = 0.0) -> list[tuple[Any, Any]]:
    """Return the largest dry friction force on the cart [N] and torque on the arm [N m], of each effect that has any.

    Args:
        model: the rig.
        state: one array per state.
        current: motor current, before the actuator effects [A]; without one, what there is of friction without load.
    """
    rubbing = [effect for effect in model.effects if isinstance(effect, DryFriction)]
    if not rubbing:
        return []
    own = own_states(model, state)
    motion = Motion(state[0], state[1], state[2], state[3], *sincos(state[2]), current, model.body)
    for effect in model.effects:
        if isinstance(effect, Actuator):
            motion = motion._replace(current=effect.current(motion.current, own[effect.id]))
    return [effect.levels(motion, own[effect.id]) for effect in rubbing]


def sensor_outputs(model: RTAC, state: tuple[Array | np.ndarray, ...]) -> Outputs:
    """Return the outputs of the sensors in a state."""
    shown = Outputs(state[0], state[3], state[2])
    own = own_states(model, state)
    # What the sensors look at comes before the sensors themselves.
    for effect in sorted(model.effects, key=lambda effect: isinstance(effect, Sensor)):
        shown = effect.read(shown, own[effect.id])
    return shown


def delivered(model: RTAC, excitation: Excitation) -> Excitation:
    """Return the excitation as it reaches the rig, after the effects on how inputs run between and across samples."""
    stages = [effect for effect in model.effects if isinstance(effect, Input)]
    if not stages:
        return excitation
    current, force = excitation.current, excitation.force
    for effect in stages:
        if current is not None:
            current = effect.transform(current, "current", excitation.sample_time)
        if force is not None:
            force = effect.transform(force, "force", excitation.sample_time)
    return dataclasses.replace(excitation, current=current, force=force)


def dead_time(model: RTAC) -> Any:
    """Return by how much the current comes later than its command [s]."""
    return sum((effect.dead_time() for effect in model.effects if isinstance(effect, Input)), start=0.0)


def state_at_start(model: RTAC, rigid: tuple[Array, Array, Array, Array], current: Number) -> tuple[Any, ...]:
    """Return the whole state at the start, from the rigid body's [m, m/s, rad, rad/s] and the current [A]."""
    state = tuple(rigid)
    if not any(effect.states for effect in model.effects):
        return state
    motion = Motion(*rigid, *sincos(rigid[2]), current, model.body)
    for effect in model.effects:
        state += effect.start(motion)
    return state


def own_states(model: RTAC, state: tuple[Array | np.ndarray, ...]) -> dict[str, tuple[Any, ...]]:
    """Return the states of each effect, by its id."""
    own, at = {}, len(RIGID_STATES)
    for effect in model.effects:
        own[effect.id] = tuple(state[at : at + len(effect.states)])
        at += len(effect.states)
    return own
