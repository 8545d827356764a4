"""What an effect is: a force, an actuator stage or a sensor stage with its own parameters, and states where it needs them.

An effect is final, immutable and knows nothing of data, optimisers or pictures. It is absent at the null value of its
parameters, and it declares how large it may plausibly be on a rig of given scales, so that the diagnosis can look for it.
"""

import itertools
from abc import abstractmethod
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
from jaxtyping import Array, Float

from rtac_jax._parameter import Scales, declarations
from rtac_jax._rigid_body import RigidBody

Values = Float[Array, "*#batch"]
"""One number per trajectory, or one for all."""
States = tuple[Any, ...]
"""An effect's own states, one array each."""


class Motion(NamedTuple):
    """What acts at one instant; arrays of one shape, one element per trajectory.

    Attributes:
        cart_position: q [m].
        cart_velocity: [m/s].
        arm_angle: theta [rad].
        arm_velocity: [rad/s].
        sin_angle, cos_angle: of theta.
        current: what reaches the motor, after the actuator effects [A].
        body: the rigid body, for effects that need a mass.
    """

    cart_position: Any
    cart_velocity: Any
    arm_angle: Any
    arm_velocity: Any
    sin_angle: Any
    cos_angle: Any
    current: Any
    body: RigidBody


class Outputs(NamedTuple):
    """What the sensors show: cart position [m], arm velocity [rad/s], arm angle [rad]."""

    cart_position: Any
    arm_velocity: Any
    arm_angle: Any


class Effect(eqx.Module):
    """A physical effect; subclass `Force`, `DryFriction`, `Actuator` or `Sensor`, never this class.

    Class attributes:
        id: the name in the catalogue.
        equation: the formula, in plain text.
        source: where it comes from.
        port: the part of the rig on which it acts.
        states: names of its own states, with units.
        free_start: whether a recording may begin with these states away from `start`, so that a fit estimates them.
    """

    id: ClassVar[str]
    equation: ClassVar[str]
    source: ClassVar[str]
    port: ClassVar[str]
    states: ClassVar[dict[str, str]] = {}
    free_start: ClassVar[bool] = False

    def __check_init__(self) -> None:
        for name, declared in declarations(self).items():
            if not declared.unit or not declared.symbol:
                raise ValueError(f"effect {self.id}: parameter {name} needs a symbol and a unit.")

    def start(self, motion: Motion) -> States:
        """The effect's own states at the start of a recording that begins in equilibrium; none unless it has states."""
        del motion
        return ()

    def rate(self, motion: Motion, own: States) -> States:
        """Time derivatives of the effect's own states; none unless the effect has states."""
        del motion, own
        return ()

    @classmethod
    def amplitudes(cls) -> tuple[str, ...]:
        """The parameters whose null values together switch the effect off."""
        return tuple(name for name, declared in declarations(cls).items() if declared.null is not None)

    @classmethod
    def absent(cls, **shape: float) -> "Effect":
        """The effect at its null value, with the shape parameters given."""
        values = {}
        for name, declared in declarations(cls).items():
            if declared.null is not None:
                values[name] = declared.null
            else:
                values[name] = shape[name] if name in shape else _default(cls, name)
        return cls(**values)

    @classmethod
    def candidates(cls, scales: Scales) -> tuple["Effect", ...]:
        """Instances of plausible size on a rig of these scales, one for each point of the grid of shapes.

        Raises:
            ValueError: a parameter has neither a plausible size nor a default.
        """
        axes = []
        for name, declared in declarations(cls).items():
            guess = declared.plausible(scales) if declared.plausible else _default(cls, name)
            axes.append(tuple(guess) if isinstance(guess, tuple) else (guess,))
        names = tuple(declarations(cls))
        return tuple(cls(**dict(zip(names, point, strict=True))) for point in itertools.product(*axes))


def _default(cls: type[Effect], name: str) -> Any:
    default = getattr(cls, "__dataclass_fields__")[name].default  # noqa: B009 - pyright knows no such attribute
    if isinstance(default, (int, float)):
        return default
    raise ValueError(
        f"effect {cls.id}: parameter {name} has no null value, no plausible size and no default; declare one."
    )


class Force(Effect):
    """An effect that acts on the cart or the arm.

    Class attributes:
        nature: "dissipative" never feeds energy in, "conservative" has a potential, "source" may do either.
    """

    nature: ClassVar[str]

    @abstractmethod
    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        """Force on the cart [N] and torque on the arm [N m]."""

    def cart_mass(self) -> Any:
        """Mass that the effect adds to the cart [kg]; negative where it takes some away."""
        return 0.0


class DryFriction(Effect):
    """Friction that opposes motion with a given level and holds what does not move.

    The time loop applies it as an impulse, exactly where the force is constant over a step, so that a rig sticks and
    no smoothing of the sign is needed.
    """

    nature: ClassVar[str] = "dissipative"

    @abstractmethod
    def levels(self, motion: Motion, own: States) -> tuple[Any, Any]:
        """Largest friction force on the cart [N] and torque on the arm [N m], neither negative."""


class Actuator(Effect):
    """An effect between the recorded current and the current that makes torque."""

    port: ClassVar[str] = "actuator"

    @abstractmethod
    def current(self, current: Any, own: States) -> Any:
        """The current after this stage [A], from the current before it [A]."""


class Sensor(Effect):
    """An effect between the motion and what is recorded."""

    port: ClassVar[str] = "sensor"

    @abstractmethod
    def read(self, outputs: Outputs, own: States) -> Outputs:
        """The outputs after this stage."""
