"""A learned force: a curve in one variable, for what no effect of the catalogue explains."""

from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rtac_jax._numbers import Number
from rtac_jax.effects._interface import Force, Motion, States
from rtac_jax.parameters import Scalar, parameter

VARIABLES = (
    "cart_position",
    "cart_velocity",
    "arm_angle",
    "arm_velocity",
    "current",
    "cart_position, against the motion",
    "arm_angle, against the motion",
)
"""On what a learned force may depend; "against the motion" is friction whose level depends on the place."""

VARIABLE_UNITS = {
    "cart_position": "m",
    "cart_velocity": "m/s",
    "arm_angle": "rad",
    "arm_velocity": "rad/s",
    "current": "A",
}
"""Of what stands before the comma in `VARIABLES`."""

PORTS = ("cart", "arm")
PORT_UNITS = {"cart": "N", "arm": "N m"}
"""Of the force on the cart and the torque on the arm."""

SHAPES = 6
"""Curves that one `SplineForce` adds up."""

Curve = Float[Array, " knot"]


def curve_value(
    heights: Sequence[Number] | Array,
    motion: Motion,
    variable: Float[Array, " variable"],
    first: Number,
    spacing: Number,
    slow: Number,
) -> Any:
    """Return the piecewise linear curve through heights at equally spaced knots, at the present value of a variable.

    See `on_curve` for the arguments.

    Source: de Boor, A Practical Guide to Splines (1978), chapter 3.
    """
    at, rubs = on_curve(motion, variable, first, spacing, slow)
    place = jnp.clip(at, 0.0, len(heights) - 1.0)
    # Scalars rather than small arrays: over a batch they become loops that vectorise, and compile in a fraction of the time.
    value = sum(height * jnp.maximum(0.0, 1.0 - jnp.abs(place - knot)) for knot, height in enumerate(heights))
    return value * rubs


def on_curve(
    motion: Motion, variable: Float[Array, " variable"], first: Number, spacing: Number, slow: Number
) -> tuple[Any, Any]:
    """Return the present place of a variable on a curve, in knots from the first, and the factor of the curve there.

    Args:
        motion: at the present instant.
        variable: one at the place of the variable in `VARIABLES`, else zero.
        first: place of the first knot, SI units.
        spacing: of the knots, SI units.
        slow: speed below which friction fades [m/s or rad/s].
    """
    turns = motion.arm_angle / (2 * jnp.pi)
    within = 2 * jnp.pi * (turns - jnp.floor(turns + 0.5))
    options = (
        motion.cart_position, motion.cart_velocity, within, motion.arm_velocity, motion.current,
        motion.cart_position, within,
    )  # fmt: skip
    at = (sum(w * x for w, x in zip(variable, options, strict=True)) - first) / spacing
    against = [-v / jnp.sqrt(v * v + slow * slow) for v in (motion.cart_velocity, motion.arm_velocity)]
    rubs = variable[5] * against[0] + variable[6] * against[1] + jnp.sum(variable[:5])
    return at, rubs


def _amount(number: int) -> Any:
    return parameter(
        symbol=f"c_{number}", unit="1", meaning=f"amount of shape {number}", null=0.0, plausible=1.0
    )  # fmt: skip


class SplineForce(Force):
    """A force that was learned: amounts of given curves in one variable, which a fit adjusts.

    Not in the catalogue: it explains nothing, it only makes the error fall. Make one with `over`, or from a curve of a
    diagnosis, whose shapes the data can tell from the parameters that the model has already.
    """

    id: ClassVar[str] = "spline_force"
    equation: ClassVar[str] = "sum of c_i s_i(x)"
    source: ClassVar[str] = "de Boor, A Practical Guide to Splines (1978), chapter 3"
    port: ClassVar[str] = "cart or arm"
    nature: ClassVar[str] = "source"

    # Numbers, not arrays: an array in a model is taken for one value per experiment.
    shapes: tuple[tuple[Float[Array, ""], ...], ...]
    on: tuple[Float[Array, ""], ...]
    variable: tuple[Float[Array, ""], ...]
    first: Float[Array, ""]
    spacing: Float[Array, ""]
    slow: Float[Array, ""]
    amount_1: Scalar = _amount(1)
    amount_2: Scalar = _amount(2)
    amount_3: Scalar = _amount(3)
    amount_4: Scalar = _amount(4)
    amount_5: Scalar = _amount(5)
    amount_6: Scalar = _amount(6)
    used: int = eqx.field(default=SHAPES, static=True)

    @property
    def idle(self) -> tuple[str, ...]:
        """Amounts of shapes that were not given."""
        return tuple(f"amount_{i + 1}" for i in range(self.used, SHAPES))

    @property
    def depends_on(self) -> str:
        """Return the variable, one of `VARIABLES`."""
        return VARIABLES[int(np.argmax([float(x) for x in self.variable]))]

    @property
    def between(self) -> tuple[float, float]:
        """Lowest and highest value of the variable, SI units; beyond them the force keeps its last value."""
        first, spacing = float(self.first), float(self.spacing)
        return first, first + spacing * (len(self.shapes[0]) - 1)

    @classmethod
    def over(
        cls,
        variable: str,
        between: tuple[float, float],
        *,
        port: str,
        shapes: np.ndarray | None = None,
        amounts: np.ndarray | None = None,
        slow: float = 1e-4,
    ) -> "SplineForce":
        """Return a learned force over a range of a variable; beyond it the force keeps its last value.

        Args:
            variable: of `VARIABLES`.
            between: lowest and highest value, SI units.
            port: "cart" [N] or "arm" [N m].
            shapes: up to six curves, a row each, as heights at equally spaced knots; by default one hat for each of six
                knots, which overlap with the stiffness, friction and torque constant of the model: fix those (`model.fix`). The
                curves of a diagnosis, `found.curves[0].effect()`, hold only what these leave over, and need nothing fixed.
            amounts: of the shapes at the start; zero by default.
            slow: speed below which friction fades [m/s or rad/s].

        Raises:
            ValueError: an unknown variable or port, an empty range, shapes or amounts of the wrong number, or a speed that is
                not positive.
        """
        if variable not in VARIABLES:
            raise ValueError(
                f"spline_force: {variable!r} is no variable; choose among {', '.join(map(repr, VARIABLES))}."
            )
        if port not in PORTS:
            raise ValueError(f"spline_force: port {port!r} must be 'cart' or 'arm'.")
        if not between[0] < between[1]:
            raise ValueError(f"spline_force: {between} is no range; write (lowest, highest).")
        table = np.eye(SHAPES) if shapes is None else np.atleast_2d(np.asarray(shapes, dtype=float))
        if len(table) > SHAPES:
            raise ValueError(f"spline_force: {len(table)} shapes; it adds up at most {SHAPES}.")
        if table.shape[1] < 2:
            raise ValueError("spline_force: a shape needs heights at two knots at least, the ends of its range.")
        if amounts is not None and np.shape(amounts) != (len(table),):
            raise ValueError(f"spline_force: amounts {np.shape(amounts)} for {len(table)} shapes; give one for each.")
        if not slow > 0:
            raise ValueError(f"spline_force: slow is {slow}; give a positive speed.")
        start = np.zeros(len(table)) if amounts is None else np.asarray(amounts, dtype=float)
        padding = np.zeros((SHAPES - len(table), table.shape[1]))
        amounts = np.append(start, np.zeros(SHAPES - len(table)))
        return cls(
            shapes=tuple(tuple(jnp.asarray(height) for height in row) for row in np.concatenate([table, padding])),
            on=tuple(jnp.asarray(float(port == p)) for p in PORTS),
            variable=tuple(jnp.asarray(float(variable == v)) for v in VARIABLES),
            first=jnp.asarray(float(between[0])),
            spacing=jnp.asarray((between[1] - between[0]) / (table.shape[1] - 1)),
            slow=jnp.asarray(float(slow)),
            used=len(table),
            **{f"amount_{i + 1}": value for i, value in enumerate(amounts)},
        )

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        del own
        amounts = (self.amount_1, self.amount_2, self.amount_3, self.amount_4, self.amount_5, self.amount_6)
        # A sum of curves over the same knots is one curve, and the heights of that do not change over time.
        heights = [
            sum(amount * height for amount, height in zip(amounts, at_knot, strict=True))
            for at_knot in zip(*self.shapes, strict=True)
        ]
        total = curve_value(heights, motion, jnp.stack(self.variable), self.first, self.spacing, self.slow)
        return self.on[0] * total, self.on[1] * total
