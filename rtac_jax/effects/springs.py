"""Springs whose stiffness depends on the cart's position, and a constant force that moves their equilibrium."""

from typing import Any, ClassVar

from rtac_jax._parameter import Scalar, parameter
from rtac_jax.effects._interface import Force, Motion, States


class CubicSpring(Force):
    """A spring that hardens (k_3 > 0) or softens (k_3 < 0) alike on both sides."""

    id: ClassVar[str] = "cubic_spring"
    equation: ClassVar[str] = "-k_3 q^3"
    source: ClassVar[str] = "Duffing; Nayfeh and Mook, Nonlinear Oscillations (1979), section 4.1"
    port: ClassVar[str] = "cart"
    nature: ClassVar[str] = "conservative"

    stiffness: Scalar = parameter(
        symbol="k_3", unit="N/m^3", meaning="cubic stiffness", null=0.0,
        plausible=lambda s: 0.02 * s.force / s.position**3,
    )  # fmt: skip

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return -self.stiffness * motion.cart_position**3, 0.0


class QuadraticSpring(Force):
    """A spring that is stiffer on one side than on the other."""

    id: ClassVar[str] = "quadratic_spring"
    equation: ClassVar[str] = "-k_2 q^2"
    source: ClassVar[str] = "Nayfeh and Mook, Nonlinear Oscillations (1979), section 2.3"
    port: ClassVar[str] = "cart"
    nature: ClassVar[str] = "conservative"

    stiffness: Scalar = parameter(
        symbol="k_2", unit="N/m^2", meaning="quadratic stiffness", null=0.0,
        plausible=lambda s: 0.02 * s.force / s.position**2,
    )  # fmt: skip

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return -self.stiffness * motion.cart_position**2, 0.0


class ForceOffset(Force):
    """A constant force: an offset of the force input, or a spring whose rest is not at the position sensor's zero."""

    id: ClassVar[str] = "force_offset"
    equation: ClassVar[str] = "F_0"
    source: ClassVar[str] = "offset of an analogue amplifier"
    port: ClassVar[str] = "cart"
    nature: ClassVar[str] = "conservative"

    offset: Scalar = parameter(
        symbol="F_0", unit="N", meaning="constant force on the cart", null=0.0, plausible=lambda s: 0.03 * s.force
    )

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return self.offset, 0.0
