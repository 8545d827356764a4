"""A declared physical parameter: a field of a module with a symbol, a unit, bounds, a meaning and a source."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rtac_jax._numbers import Number

if TYPE_CHECKING:
    Scalar = Any  # constructors take numbers too and convert them, which type checkers cannot see
else:
    Scalar = Float[Array, "*batch"]
"""A parameter's value: a scalar, or one value for each experiment."""

_KEY = "rtac_parameter"


@dataclasses.dataclass(frozen=True)
class Scales:
    """The typical sizes in a recording and its model, SI units, by which a missing effect is plausible or absurd.

    Attributes:
        position: rms cart position [m].
        velocity: rms cart velocity [m/s].
        arm_velocity: rms arm velocity [rad/s].
        current: rms motor current [A].
        force: rms spring force or recorded force on the cart, whichever is larger [N].
        torque: rms motor torque or arm inertia torque, whichever is larger [N m].
        frequency: the cart's natural frequency [rad/s].
        mass: total mass [kg].
        sample_time: shortest sample time [s].
        applied_force: rms recorded force on the cart [N]; next to nothing where there is none.
    """

    position: float
    velocity: float
    arm_velocity: float
    current: float
    force: float
    torque: float
    frequency: float
    mass: float
    sample_time: float
    applied_force: float = 1e-9


Plausible = Callable[[Scales], "float | tuple[float, ...]"]


@dataclasses.dataclass(frozen=True)
class Declaration:
    """The knowledge of a parameter before any data.

    Attributes:
        symbol: as in the paper or the field, for tables and axes.
        unit: SI unit; "1" where there is none.
        meaning: a few words.
        bounds: physical limits, either may be infinite.
        source: where the equation or the value comes from.
        null: the value at which the effect is absent; None for a parameter that only shapes it.
        plausible: from the scales of a rig, a size worth looking for, or a grid of them for a shape parameter.
        fixed: not estimated unless asked for by name.
        largest: size that it may have however little is plausible, as gravity where the arm's plane is vertical; zero for none.
    """

    symbol: str
    unit: str
    meaning: str
    bounds: tuple[float, float]
    source: str
    null: float | None
    plausible: Plausible | None
    fixed: bool
    largest: float


def parameter(
    *,
    symbol: str,
    unit: str,
    meaning: str,
    bounds: tuple[float, float] = (-np.inf, np.inf),
    source: str = "",
    null: float | None = None,
    plausible: Plausible | float | tuple[float, ...] | None = None,
    fixed: bool = False,
    largest: float = 0.0,
    default: Any = dataclasses.MISSING,
) -> Any:
    """Declare a parameter of a rigid body or of an effect; the arguments are those of `Declaration`.

    Raises:
        ValueError: the bounds are not an interval.
    """
    if not bounds[0] < bounds[1]:
        raise ValueError(f"parameter {symbol}: bounds {bounds} are not an interval; write (lower, upper).")
    guess = plausible if plausible is None or callable(plausible) else (lambda _, value=plausible: value)
    declared = Declaration(symbol, unit, meaning, bounds, source, null, guess, fixed, largest)
    extra = {} if default is dataclasses.MISSING else {"default": default}
    return eqx.field(converter=as_value, metadata={_KEY: declared}, **extra)


def as_value(value: Number | Sequence[Number]) -> Array:
    """Return a value of a parameter as an array of JAX; it may be traced."""
    # A number by way of NumPy, in half the time: studies make models by the thousand.
    return jnp.asarray(np.float64(value)) if isinstance(value, int | float) else jnp.asarray(value, dtype=float)


def declarations(module: object) -> dict[str, Declaration]:
    """Return the declared parameters of a module or of its class, by field name, in order of declaration."""
    return dict(_declared(module if isinstance(module, type) else type(module)))


@functools.cache
def _declared(module: type) -> dict[str, Declaration]:
    return {field.name: field.metadata[_KEY] for field in dataclasses.fields(module) if _KEY in field.metadata}
