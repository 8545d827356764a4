"""The rig's model: a rigid body and the effects that act on it; `model + effect` is another model."""

from collections.abc import Mapping
from typing import Any, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from rtac_jax._parameter import Declaration, declarations
from rtac_jax._rigid_body import RigidBody
from rtac_jax._sincos import sincos
from rtac_jax.effects import Actuator, ArmViscous, CartCoulomb, CartViscous, Effect, Force, Motion, Outputs, Sensor
from rtac_jax.measurement import Recording

RIGID_STATES = {"cart_position": "m", "cart_velocity": "m/s", "arm_angle": "rad", "arm_velocity": "rad/s"}

_PAPER = {
    "total_mass": 1.23,
    "arm_inertia": 9.5e-5,
    "eccentric_moment": 1.06e-3,
    "spring_stiffness": 132.6,
    "torque_constant": 8.04e-2,
}  # paper, Table 1


class RTAC(eqx.Module):
    """A rigid body with effects.

    Attributes:
        body: equations (1) and (2).
        effects: what else acts, in the order in which actuator and sensor stages follow each other.
        fixed: names of parameters that are not estimated, though they could be.
        per_experiment: names of parameters that each experiment has for itself.

    Parameters are named `total_mass` for the body's and `cart_viscous.coefficient` for an effect's.
    """

    body: RigidBody
    effects: tuple[Effect, ...] = ()
    fixed: frozenset[str] = eqx.field(default=frozenset(), static=True)
    per_experiment: frozenset[str] = eqx.field(default=frozenset(), static=True)

    def __check_init__(self) -> None:
        ids = [effect.id for effect in self.effects]
        twice = sorted({name for name in ids if ids.count(name) > 1})
        if twice:
            raise ValueError(f"the model already has {', '.join(twice)}; change its parameters with with_values.")
        unknown = sorted((self.fixed | self.per_experiment) - set(self.parameters))
        if unknown:
            raise ValueError(
                f"no parameter is called {', '.join(unknown)}; this model has {', '.join(self.parameters)}."
            )

    @classmethod
    def paper(cls) -> Self:
        """The rig of the paper: Table 1, and v and d of section 4.2."""
        return cls(
            RigidBody(**_PAPER),
            (CartViscous(0.5543), CartCoulomb(0.024), ArmViscous(1.39e-4, 1.49e-4)),
        )

    @classmethod
    def from_rig(cls, recording: Recording) -> Self:
        """The paper's model for the rig of a recording: known constants are fixed, and what nothing excites is left out.

        The other parameters start at the paper's values; an estimator finds better ones from the data.

        Raises:
            ValueError: the recording names a constant that the model does not have.
        """
        moves = [e for e in recording.experiments if e.kind != "rest"]
        arm = any(e.arm == "free" for e in moves)
        cart = any(e.cart == "free" for e in moves)
        driven = any("current" in e.inputs and np.any(e.inputs["current"].values != 0) for e in moves)
        effects: list[Effect] = []
        if cart:
            effects += [CartViscous(0.5543), CartCoulomb(0.024)]
        if arm:
            effects.append(ArmViscous(1.39e-4, 1.49e-4))
        fixed = set(recording.rig)
        if not arm:
            fixed |= {"arm_inertia", "eccentric_moment", "torque_constant"}
        if not cart:
            fixed |= {"total_mass", "eccentric_moment", "spring_stiffness"}
        if not driven:
            fixed.add("torque_constant")
        known = {name: float(value) for name, value in recording.rig.items()}
        model = cls(RigidBody(**_PAPER), tuple(effects))
        unknown = sorted(set(known) - set(model.parameters))
        if unknown:
            raise ValueError(
                f"/rig names {', '.join(unknown)}, which this model does not have; it has {', '.join(model.parameters)}."
            )
        return model.with_values(known).fix(*(fixed & set(model.parameters)))

    # -- composition -------------------------------------------------------------------------------------------------

    def __add__(self, effect: Effect) -> Self:
        if not isinstance(effect, Effect):
            return NotImplemented
        return type(self)(self.body, (*self.effects, effect), self.fixed, self.per_experiment)

    def without(self, *ids: str) -> Self:
        """The model less the effects with these ids.

        Raises:
            ValueError: the model has no such effect.
        """
        missing = sorted(set(ids) - {effect.id for effect in self.effects})
        if missing:
            raise ValueError(f"the model has no effect {', '.join(missing)}; it has {', '.join(self.ids)}.")
        kept = tuple(effect for effect in self.effects if effect.id not in ids)
        gone = {name for name in self.parameters if name.split(".")[0] in ids}
        return type(self)(self.body, kept, self.fixed - gone, self.per_experiment - gone)

    @property
    def ids(self) -> tuple[str, ...]:
        """Ids of the effects."""
        return tuple(effect.id for effect in self.effects)

    def __contains__(self, effect_id: str) -> bool:
        return effect_id in self.ids

    # -- parameters --------------------------------------------------------------------------------------------------

    @property
    def parameters(self) -> dict[str, Declaration]:
        """Every parameter's declaration by name."""
        found = dict(declarations(self.body))
        for effect in self.effects:
            found |= {f"{effect.id}.{name}": declared for name, declared in declarations(effect).items()}
        return found

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the parameters that a fit estimates."""
        return tuple(n for n, declared in self.parameters.items() if n not in self.fixed and not declared.fixed)

    def __getitem__(self, name: str) -> Any:
        """The value of a parameter.

        Raises:
            KeyError: there is none of that name.
        """
        owner, field = self._locate(name)
        return getattr(owner, field)

    def _locate(self, name: str) -> tuple[Any, str]:
        if name not in self.parameters:
            raise KeyError(f"no parameter is called {name}; this model has {', '.join(self.parameters)}.")
        if "." not in name:
            return self.body, name
        effect_id, field = name.split(".", 1)
        return self.effects[self.ids.index(effect_id)], field

    def with_values(self, values: Mapping[str, Any]) -> Self:
        """The model with other values of some parameters; values may be traced, or one for each experiment."""
        if not values:
            return self
        names = tuple(values)
        return eqx.tree_at(
            lambda model: tuple(getattr(*model._locate(name)) for name in names),
            self,
            tuple(jnp.asarray(values[name], dtype=float) for name in names),
        )

    def fix(self, *names: str) -> Self:
        """The model with these parameters held at their values."""
        return type(self)(self.body, self.effects, self.fixed | set(names), self.per_experiment)

    def release(self, *names: str) -> Self:
        """The model with these parameters estimated."""
        return type(self)(self.body, self.effects, self.fixed - set(names), self.per_experiment)

    def each_experiment(self, *names: str) -> Self:
        """The model with a value of its own for each experiment in these parameters."""
        return type(self)(self.body, self.effects, self.fixed, self.per_experiment | set(names))

    def table(self) -> str:
        """Parameters with symbol, value, unit and meaning, one a line."""
        rows = []
        for name, declared in self.parameters.items():
            value = np.asarray(self[name])
            shown = f"{float(value):.6g}" if value.ndim == 0 else f"{value.size} values"
            note = "" if name in self.free else "  (fixed)"
            rows.append(f"{name:32s} {declared.symbol:10s} {shown:>12s} {declared.unit:10s} {declared.meaning}{note}")
        return "\n".join(rows)

    # -- dynamics ----------------------------------------------------------------------------------------------------

    @property
    def states(self) -> dict[str, str]:
        """Names and units of the states: the rigid body's four, then those of the effects."""
        found = dict(RIGID_STATES)
        for effect in self.effects:
            found |= {f"{effect.id}.{name}": unit for name, unit in effect.states.items()}
        return found

    def start(self, rigid: tuple[Any, Any, Any, Any], current: Any) -> tuple[Any, ...]:
        """The whole state at the start, from the rigid body's [m, m/s, rad, rad/s] and the current [A]."""
        sine, cosine = sincos(rigid[2])
        motion = Motion(*rigid, sine, cosine, current, self.body)
        state = tuple(rigid)
        for effect in self.effects:
            state += effect.start(motion)
        return state

    def derivative(
        self, state: tuple[Any, ...], current: Any, force: Any, arm_free: Any = 1.0, cart_free: Any = 1.0
    ) -> tuple[Any, ...]:
        """Time derivative of the state: equations (1) and (2) with the effects.

        Args:
            state: one array per state; all of one shape.
            current: motor current [A].
            force: disturbance force F on the cart [N].
            arm_free, cart_free: 1 where it may move, 0 where it is held.
        """
        position, velocity, angle, arm_velocity, *_ = state
        sine, cosine = sincos(angle)
        body = self.body
        own = self._own_states(state)
        rates: dict[str, tuple[Any, ...]] = {}
        motion = Motion(position, velocity, angle, arm_velocity, sine, cosine, current, body)
        for effect in self.effects:
            if isinstance(effect, Actuator):
                rates[effect.id] = effect.rate(motion, own[effect.id])
                motion = motion._replace(current=effect.current(motion.current, own[effect.id]))

        cart = force - body.spring_stiffness * position + body.eccentric_moment * arm_velocity**2 * sine
        arm = body.torque_constant * motion.current
        mass = body.total_mass
        for effect in self.effects:
            if isinstance(effect, Force):
                on_cart, on_arm = effect.force(motion, own[effect.id])
                cart, arm, mass = cart + on_cart, arm + on_arm, mass + effect.cart_mass()
            if not isinstance(effect, Actuator):
                rates[effect.id] = effect.rate(motion, own[effect.id])

        exchange = body.eccentric_moment * cosine * (arm_free * cart_free)
        scale = 1.0 / (mass * body.arm_inertia - exchange * exchange)
        result = (
            velocity,
            cart_free * scale * (body.arm_inertia * cart - exchange * arm),
            arm_velocity,
            arm_free * scale * (mass * arm - exchange * cart),
        )
        for effect in self.effects:
            result += tuple(rates[effect.id])
        return result

    def outputs(self, state: tuple[Any, ...]) -> Outputs:
        """What the sensors show of a state."""
        shown = Outputs(state[0], state[3], state[2])
        own = self._own_states(state)
        for effect in self.effects:
            if isinstance(effect, Sensor):
                shown = effect.read(shown, own[effect.id])
        return shown

    def _own_states(self, state: tuple[Any, ...]) -> dict[str, tuple[Any, ...]]:
        own, at = {}, len(RIGID_STATES)
        for effect in self.effects:
            own[effect.id] = tuple(state[at : at + len(effect.states)])
            at += len(effect.states)
        return own
