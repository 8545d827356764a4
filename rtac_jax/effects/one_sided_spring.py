"""A spring that is stiffer on one side: a gross effect that no series of smooth springs follows."""

from typing import Any, ClassVar

import jax.numpy as jnp

from rtac_jax.effects._interface import Effect, Force, Motion, States
from rtac_jax.parameters import Scalar, parameter


class OneSidedSpring(Force):
    """A second spring that pushes on one side of the rest only, as a coil that loses contact or a rubber buffer does.

    A quadratic spring is smooth at rest and grows with the square of the way; this one has a corner there and grows with the way.
    It is not in the catalogue, which every diagnosis goes through, as what is small of it looks like a quadratic spring.
    """

    id: ClassVar[str] = "one_sided_spring"
    equation: ClassVar[str] = "-k_1 max(q, 0)"
    source: ClassVar[str] = "Shaw and Holmes, Journal of Sound and Vibration 90 (1983), a piecewise linear oscillator"
    port: ClassVar[str] = "cart"
    nature: ClassVar[str] = "conservative"

    stiffness: Scalar = parameter(
        symbol="k_1", unit="N/m", meaning="stiffness for q > 0 beyond that for q < 0", null=0.0,
        plausible=lambda s: 0.03 * s.force / s.position,
    )  # fmt: skip

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return -self.stiffness * jnp.maximum(motion.cart_position, 0.0), 0.0


GROSS: dict[str, type[Effect]] = {OneSidedSpring.id: OneSidedSpring}
"""Effects, by id, that a diagnosis offers only where the fit of the model follows nothing, and `improve` where no effect of the
catalogue is the force on the cart against its position that is missing."""
