"""The interface of an effect: a force, an input, actuator or sensor stage with its own parameters and, if needed, states.

An effect is final, immutable and knows nothing of data, optimisers or pictures. It is absent at the null value of its
parameters, and it declares how large it may plausibly be on a rig of given scales, so that the diagnosis can look for it.
"""

import itertools
import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from rtac_jax._numbers import Number
from rtac_jax._rigid_body import RigidBody
from rtac_jax.parameters import Scales, declarations

Values = Float[Array, "*#batch"]
"""One number per trajectory, or one for all."""
States = tuple[Any, ...]
"""An effect's own states, one array each."""
Pieces = Float[Array, "sample _ experiment"]
"""An input as one polynomial for each interval between samples."""


PORTS = ("cart", "arm", "arm and cart", "actuator", "force drive", "input", "sensor")
"""Parts of the rig on which an effect acts."""


class Motion(NamedTuple):
    """The motion of the rig at one instant; arrays of one shape, one element per trajectory.

    Attributes:
        cart_position: q [m].
        cart_velocity: [m/s].
        arm_angle: theta [rad].
        arm_velocity: [rad/s].
        sin_angle, cos_angle: of theta.
        current: what reaches the motor, after the actuator effects [A]; for an actuator effect, what reaches it.
        body: the rigid body, for effects that need a mass.
        began: the motion at the beginning of the integration step; None where no step is being taken.
        elapsed: fraction of the step that has gone by.
        step: its length [s].
        last: the current at its end [A].
        cart_acceleration, arm_acceleration: [m/s^2, rad/s^2]; known to sensors only.
        force: the recorded force on the cart [N]; known to forces only.
    """

    cart_position: Any
    cart_velocity: Any
    arm_angle: Any
    arm_velocity: Any
    sin_angle: Any
    cos_angle: Any
    current: Any
    body: RigidBody
    began: Any = None
    elapsed: Any = 0.0
    step: Any = 0.0
    last: Any = 0.0
    cart_acceleration: Any = 0.0
    arm_acceleration: Any = 0.0
    force: Any = 0.0


class Outputs(NamedTuple):
    """The outputs of the sensors: cart position [m], arm velocity [rad/s], arm angle [rad]."""

    cart_position: Any
    arm_velocity: Any
    arm_angle: Any


class Effect(eqx.Module):
    """A physical effect; subclass `Force`, `DryFriction`, `Impact`, `Actuator`, `Input` or `Sensor`, never this class.

    Class attributes:
        id: the name in the catalogue.
        equation: the formula, in plain text.
        source: where it comes from.
        port: the part of the rig on which it acts: "cart", "arm", "arm and cart", "actuator" (the current), "force drive" (the
            recorded force), "input" (any input) or "sensor". An effect on a part that never moves, or is never driven, cannot be
            seen.
        needs_channel: name of the output without which it cannot be seen either, as that of a sensor; None if there is none.
        undriven: whether a diagnosis offers it only where no current drives the motor, since another effect is the same elsewhere.
        most_turns: turns of the arm in one experiment beyond which no rig has it, as that of a cable that would be torn.
        only_beside: ids of effects that a model must have before a diagnosis looks for it, as it is one of them elsewhere.
        states: names of its own states, with units.
        contains: ids of simpler effects that it becomes at the edge of its shape. Where the data cannot tell it from one of
            them, that one is named.
        edge: a parameter of its shape that is zero at that edge, and the output of the same unit: well below the noise of that
            output, or below the way in one sample from rest, the effect is the one that it contains. None if it has none.
        presupposes: ids of effects beside which it stands on a rig: a law of its own only where the data rule those out, as
            Stribeck friction is what dry friction has more of near rest.
        resembles: ids of effects that change the motion as it does, whatever their size, so that they are refitted
            beside it where screening puts it first, whatever it says of them.
        free_start: whether a recording may begin with these states away from `start`, so that a fit estimates them.
        closed: whether the states follow in closed form over a step (`follow`) instead of by integrating `rate`. A lag
            is exact in this way and may be as short as it likes without asking for small steps.
        looked_at: fraction of the plausible size at which a diagnosis looks at what it changes. It takes that for the slope, and
            carries it to other sizes, so this is below 1 for what changes the motion far from in proportion to its size (0.1 for
            a fifth power of position), or moves it far off until the other parameters follow (0.01 for a mass).
        acts_by_contact: whether parts hit each other, so that it acts at instants that move by whole steps as a parameter changes
            and derivatives do not tell of them.
    """

    id: ClassVar[str]
    equation: ClassVar[str]
    source: ClassVar[str]
    port: ClassVar[str]
    states: ClassVar[dict[str, str]] = {}
    contains: ClassVar[tuple[str, ...]] = ()
    edge: ClassVar[tuple[str, str] | None] = None
    presupposes: ClassVar[tuple[str, ...]] = ()
    resembles: ClassVar[tuple[str, ...]] = ()
    free_start: ClassVar[bool] = False
    closed: ClassVar[bool] = False
    needs_channel: ClassVar[str | None] = None
    undriven: ClassVar[bool] = False
    only_beside: ClassVar[tuple[str, ...]] = ()
    most_turns: ClassVar[float] = math.inf
    looked_at: ClassVar[float] = 1.0
    acts_by_contact: ClassVar[bool] = False

    def __check_init__(self) -> None:
        for name, declared in declarations(self).items():
            if not declared.unit or not declared.symbol:
                raise ValueError(f"effect {self.id}: parameter {name} needs a symbol and a unit.")

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{n}={_shown(getattr(self, n))}' for n in declarations(self))})"

    def start(self, motion: Motion) -> States:
        """Return the effect's own states at the start of a recording that begins in equilibrium; none by default."""
        del motion
        return ()

    def remark(self, body: RigidBody) -> str:
        """Return a sentence on estimates of this size that mean something else than their names say; none by default."""
        del body
        return ""

    def unseen(self, extents: Mapping[str, tuple[float, float]]) -> str:
        """Return a sentence on what of it a recording did not reach, so that it is assumed; none by default.

        Args:
            extents: lowest and highest value of each output that was recorded, SI units.
        """
        del extents
        return ""

    def reach(self) -> States:
        """Return how far from nothing each own state of a `free_start` may be at the start; none, by default, for any distance."""
        return ()

    def rate(self, motion: Motion, own: States) -> States:
        """Return the time derivatives of the effect's own states; none by default."""
        del motion, own
        return ()

    def follow(self, motion: Motion, own: States) -> States:
        """Return the states of a `closed` effect at the end of a step, from those at its beginning, `motion.began`."""
        del motion
        return own

    def during(self, motion: Motion, own: States) -> States:
        """Return the states that a `closed` effect acts with when `motion.elapsed` of a step has gone by.

        Runge-Kutta steps sample it at 0, 1/2 and 1. What changes faster than that has to be smoothed with its mean kept.
        """
        return self.follow(motion, own)

    def read(self, outputs: Outputs, own: States) -> Outputs:
        """Return the outputs after this effect; unchanged unless the effect acts on what the sensors see."""
        del own
        return outputs

    @property
    def idle(self) -> tuple[str, ...]:
        """Parameters that do nothing in this instance, which a model does not set free; none but of a learned force."""
        return ()

    @classmethod
    def amplitudes(cls) -> tuple[str, ...]:
        """Return the names of the parameters whose null values together switch the effect off."""
        return tuple(name for name, declared in declarations(cls).items() if declared.null is not None)

    @classmethod
    def absent(cls, **shape: float) -> "Effect":
        """Return the effect at its null value, with the shape parameters given."""
        values = {}
        for name, declared in declarations(cls).items():
            if declared.null is not None:
                values[name] = declared.null
            else:
                values[name] = shape[name] if name in shape else _default(cls, name)
        return cls(**values)

    @classmethod
    def candidates(cls, scales: Scales) -> tuple["Effect", ...]:
        """Return instances of plausible size on a rig of these scales, one for each point of the grid of shapes.

        Raises:
            ValueError: a parameter has neither a plausible size nor a default.
        """
        axes = []
        for name, declared in declarations(cls).items():
            guess = declared.plausible(scales) if declared.plausible else _default(cls, name)
            axes.append(tuple(guess) if isinstance(guess, tuple) else (guess,))
        names = tuple(declarations(cls))
        return tuple(cls(**dict(zip(names, point, strict=True))) for point in itertools.product(*axes))


def in_parts(told: object, effect: Effect, method: str, parts: Sequence[str]) -> tuple[Any, ...]:
    """Return the values that a method of an effect returned, one for each part, after checking their number.

    The method may be a user's own.

    Raises:
        ValueError: it returns something else; one array with as many rows as there are parts would be taken apart unseen.
    """
    if not isinstance(told, (tuple, list)) or len(told) != len(parts):
        kind = "array" if hasattr(told, "shape") else type(told).__name__
        given = f"{len(told)} value(s)" if isinstance(told, (tuple, list)) else f"one {kind}"
        raise ValueError(
            f"effect {effect.id}: {method} returns {given}; return a tuple of {len(parts)}: {', '.join(parts) or 'nothing'}."
        )
    return tuple(told)


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
        """Return the force on the cart [N] and the torque on the arm [N m]."""

    def cart_mass(self) -> Any:
        """Return the mass that the effect adds to the cart [kg]; negative where it takes some away."""
        return 0.0

    def arm_inertia(self, body: RigidBody) -> Any:
        """Return the inertia that the effect adds to the arm [kg m^2]; negative where it takes some away."""
        del body
        return 0.0


class DryFriction(Effect):
    """Friction that opposes motion with a given level and holds what does not move.

    The time loop applies it as an impulse, exactly where the force is constant over a step, so that a rig sticks and
    no smoothing of the sign is needed.
    """

    nature: ClassVar[str] = "dissipative"

    @abstractmethod
    def levels(self, motion: Motion, own: States) -> tuple[Any, Any]:
        """Return the largest friction force on the cart [N] and torque on the arm [N m], neither negative."""


class Impact(Effect):
    """An effect whose parts hit each other: it changes velocities at once, after each integration step.

    States in m or rad say how far the parts are apart; a predictor counts them as known to a part of what they move in a sample.
    """

    nature: ClassVar[str] = "dissipative"
    acts_by_contact: ClassVar[bool] = True

    def rate(self, motion: Motion, own: States) -> States:
        """Return zero rates: between impacts nothing happens that the step does not know."""
        del motion
        return tuple(0.0 * x for x in own)

    @abstractmethod
    def strike(self, motion: Motion, own: States, mobility: Number) -> tuple[States, Any, Any]:
        """Return the states and the impulse after the step that ends with this motion.

        Args:
            motion: at the end of the step, which was taken without the effect; `began` and `elapsed` are set.
            own: the states at the beginning of the step.
            mobility: angular acceleration of the arm by a unit torque [rad/s^2/(N m)]; zero where it is held.

        Returns:
            The effect's own states at the end of the step, the impulse on the arm in the step [N m s], and its moment
            about the end of the step [N m s^2], which moves the arm at once.
        """


class Actuator(Effect):
    """An effect between the recorded current and the current that makes torque."""

    port: ClassVar[str] = "actuator"

    @abstractmethod
    def current(self, current: Number, own: States) -> Any:
        """Return the current after this stage [A], from the current before it [A]."""


class Input(Effect):
    """An effect on how the inputs run between and across their samples, known before anything moves."""

    port: ClassVar[str] = "actuator"

    @abstractmethod
    def transform(self, coefficients: Pieces, channel: str, sample_time: Number) -> Pieces:
        """Return an input after this stage, as polynomials in the fraction of each interval, rising powers.

        Args:
            coefficients: of the input before this stage.
            channel: "current" or "force".
            sample_time: of each experiment [s].
        """

    def dead_time(self) -> Any:
        """Return by how much the current comes later than its command [s], which a linearised model needs to know."""
        return 0.0


class Sensor(Effect):
    """An effect between the motion and what is recorded."""

    port: ClassVar[str] = "sensor"

    @abstractmethod
    def read(self, outputs: Outputs, own: States) -> Outputs:
        """Return the outputs after this stage."""


def _shown(value: object) -> str:
    """Return a parameter's value in a few characters; of what is traced or no number, what it is."""
    try:
        numbers = np.asarray(value, dtype=float)
    except Exception:  # a tracer has no value, and a placeholder may be anything
        return type(value).__name__
    return f"{float(numbers):.6g}" if numbers.ndim == 0 else f"{numbers.size} values"
