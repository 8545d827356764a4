"""The equations of motion of a rigid body with effects, and what the end of an integration step adds to them."""

from typing import Any, Protocol, runtime_checkable

from rtac_jax._rigid_body import RigidBody
from rtac_jax._since import Since, through
from rtac_jax._sincos import sincos
from rtac_jax.effects import Actuator, DryFriction, Effect, Force, Impact, Motion, Sensor
from rtac_jax.effects._interface import in_parts

_PORTS = ("on the cart", "on the arm")
RIGID_STATES = {"cart_position": "m", "cart_velocity": "m/s", "arm_angle": "rad", "arm_velocity": "rad/s"}


@runtime_checkable
class Moving(Protocol):
    """A model, as far as the equations ask for it; `RTAC` says what each of these is."""

    @property
    def body(self) -> RigidBody:
        """Return the rigid body."""
        ...

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Return what else acts."""
        ...

    def own_states(self, state: tuple[Any, ...]) -> dict[str, tuple[Any, ...]]:
        """Return the states of each effect, by its id."""
        ...

    def mobility(self, cosine: Any, arm_free: Any, cart_free: Any) -> tuple[Any, Any, Any]:
        """Return the inverse of the mass matrix."""
        ...

    def since(self, state: tuple[Any, ...], current: Any, step: Any, last: Any) -> Since:
        """Return the beginning of a step."""
        ...


def derivative(
    model: Moving,
    state: tuple[Any, ...],
    current: Any,
    force: Any,
    arm_free: Any,
    cart_free: Any,
    way: tuple[Any, Any],
    since: Since | None,
) -> tuple[Any, ...]:
    """Return the time derivative of the state, as `RTAC.derivative` says."""
    position, velocity, angle, arm_velocity, *_ = state
    sine, cosine = sincos(angle)
    body = model.body
    own = model.own_states(state)
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

    cart_cart, cart_arm, arm_arm = model.mobility(cosine, arm_free, cart_free)
    result = (velocity, cart_cart * cart + cart_arm * arm, arm_velocity, cart_arm * cart + arm_arm * arm)
    motion = motion._replace(cart_acceleration=result[1], arm_acceleration=result[3])
    for effect in model.effects:
        if isinstance(effect, Sensor):
            rates[effect.id] = act(effect)
        result += rates[effect.id]
    return result


def integrated(model: Moving) -> list[int]:
    """Return the places of the states that are integrated, and do not follow in closed form from where a step began."""
    closed = [False] * len(RIGID_STATES) + [effect.closed for effect in model.effects for _ in effect.states]
    return [place for place, follows in enumerate(closed) if not follows]


def settle(model: Moving, after: tuple[Any, ...], since: Since, arm_free: Any, cart_free: Any) -> tuple[Any, ...]:
    """Return the state after a step, as `RTAC.settle` says."""
    own = model.own_states(after)
    motion = since.seen_from(model.since(after, since.last, since.step, since.last).motion)
    rigid = list(after[:4])
    for effect in model.effects:
        if isinstance(effect, Actuator):
            before = own[effect.id]
            own[effect.id] = effect.follow(motion, before) if effect.closed else before
            motion = through(effect, motion, before, own[effect.id])
    for effect in model.effects:
        if isinstance(effect, Impact):
            _, cart_arm, arm_arm = model.mobility(motion.cos_angle, arm_free, cart_free)
            own[effect.id], impulse, moment = effect.strike(motion, own[effect.id], arm_arm)
            rigid[0], rigid[1] = rigid[0] + cart_arm * moment, rigid[1] + cart_arm * impulse
            rigid[2], rigid[3] = rigid[2] + arm_arm * moment, rigid[3] + arm_arm * impulse
    motion = motion._replace(**dict(zip(RIGID_STATES, rigid, strict=True)))
    for effect in model.effects:
        if effect.closed and not isinstance(effect, Actuator):
            own[effect.id] = effect.follow(motion, own[effect.id])
    return (*rigid, *(x for effect in model.effects for x in own[effect.id]))
