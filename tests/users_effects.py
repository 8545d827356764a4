"""Effects that a user adds."""

from typing import Any, ClassVar

from rtac_jax import parameter
from rtac_jax.effects import Force


class Counted(Force):
    """A spring that counts how often it is compiled."""

    id: ClassVar[str] = "counted"
    equation: ClassVar[str] = "-k q"
    source: ClassVar[str] = "none"
    port: ClassVar[str] = "cart"
    nature: ClassVar[str] = "conservative"
    calls: ClassVar[list[int]] = []
    stiffness: Any = parameter(symbol="k", unit="N/m", meaning="spring", null=0.0)

    def force(self, motion, own):
        # Runs while the code is traced, never when it is executed.
        self.calls.append(1)
        return -self.stiffness * motion.cart_position, 0.0


class MagneticSpring(Force):
    """A force of the user's own."""

    id: ClassVar[str] = "magnetic_spring"
    equation: ClassVar[str] = "-k_5 q^5"
    source: ClassVar[str] = "own rig"
    port: ClassVar[str] = "cart"
    nature: ClassVar[str] = "conservative"
    stiffness: object = parameter(symbol="k_5", unit="N/m^5", meaning="stiffness", null=0.0, plausible=1.0)

    def force(self, motion, own):
        return -self.stiffness * motion.cart_position**5, 0.0
