"""An unknown force at one port of the rig as a function of one variable, by its heights at knots: for derivatives at zero."""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rtac_jax.effects import Force, Motion, States
from rtac_jax.effects.spline_force import VARIABLES, on_curve
from rtac_jax.programs.arrays import to_jax

KNOTS = 12


class ForceProbe(Force):
    """An unknown force at one port as a piecewise linear function of one variable; for `jax.jvp` at zero only."""

    id: ClassVar[str] = "probe"
    equation: ClassVar[str] = "sum of hat functions"
    source: ClassVar[str] = "de Boor, A Practical Guide to Splines (1978), chapter 3"
    port: ClassVar[str] = "cart or arm"
    nature: ClassVar[str] = "source"

    heights: Float[Array, " knot"]
    on: Float[Array, "2"]
    variable: Float[Array, " variable"]
    first: Array
    spacing: Array
    slow: Array

    @classmethod
    def between(cls, port: int, variable: int, low: float, high: float, slow: float) -> "ForceProbe":
        """Return a probe of zero height.

        Args:
            port: its number in `rtac_jax.effects.spline_force.PORTS`.
            variable: its number in `rtac_jax.effects.spline_force.VARIABLES`.
            low: value of the variable at the first knot, in its unit.
            high: at the last.
            slow: speed below which friction fades [m/s or rad/s].
        """
        spacing = (high - low) / (KNOTS - 1)
        numbers = (np.zeros(KNOTS), np.eye(2)[port], np.eye(len(VARIABLES))[variable], low, spacing, slow)
        return cls(*(to_jax(np.asarray(number, dtype=float)) for number in numbers))

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        """Return force on the cart [N] and torque on the arm [N m] at the present value of the variable."""
        # At zero heights it does not matter how the hats change with the motion, and stopping that saves half the time.
        at, rubs = jax.lax.stop_gradient(on_curve(motion, self.variable, self.first, self.spacing, self.slow))
        at = jnp.clip(at, 0.0, KNOTS - 1.0)
        total = sum(self.heights[k] * (jnp.maximum(0.0, 1.0 - jnp.abs(at - k)) * rubs) for k in range(KNOTS))
        return self.on[0] * total, self.on[1] * total
