"""A second structural mode: part of the mass on a spring and damper of its own."""

from typing import Any, ClassVar

import numpy as np

from rtac_jax.effects._interface import Force, Motion, States
from rtac_jax.parameters import Scalar, parameter


class FlexibleMode(Force):
    """A part of the total mass that hangs on the cart by its own spring and damper.

    With r the displacement of the part relative to the cart and w, z its frequency and damping on a clamped cart,
    q'' + r'' = -w^2 r - 2 z w r'. The states are r and the part's absolute velocity, so that no acceleration is needed.
    """

    id: ClassVar[str] = "flexible_mode"
    equation: ClassVar[str] = "m_f (w^2 r + 2 z w r') on a cart that is lighter by m_f"
    source: ClassVar[str] = "paper, section 5.3: the peak at 37.4 rad/s"
    port: ClassVar[str] = "cart"
    nature: ClassVar[str] = "dissipative"
    states: ClassVar[dict[str, str]] = {"displacement": "m", "velocity": "m/s"}
    free_start: ClassVar[bool] = True

    mass: Scalar = parameter(
        symbol="m_f", unit="kg", bounds=(0.0, np.inf), meaning="mass that moves on its own spring", null=0.0,
        plausible=lambda s: 0.05 * s.mass,
    )  # fmt: skip
    frequency: Scalar = parameter(
        symbol="w_f", unit="rad/s", bounds=(0.0, np.inf), meaning="natural frequency on a clamped cart",
        plausible=lambda s: tuple(
            s.frequency * ratio for ratio in np.geomspace(1.5, 12.0, 10) if s.frequency * ratio < 1.5 / s.sample_time
        ),
    )  # fmt: skip
    damping: Scalar = parameter(
        symbol="z_f", unit="1", bounds=(0.0, 1.0), meaning="damping ratio on a clamped cart", plausible=0.05
    )

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return self.mass * self._pull(motion, own), 0.0

    def cart_mass(self) -> Any:
        return -self.mass

    def start(self, motion: Motion) -> States:
        return 0.0 * motion.cart_position, motion.cart_velocity

    def rate(self, motion: Motion, own: States) -> States:
        return own[1] - motion.cart_velocity, -self._pull(motion, own)

    def _pull(self, motion: Motion, own: States) -> Any:
        displacement, velocity = own
        relative = velocity - motion.cart_velocity
        return self.frequency**2 * displacement + 2 * self.damping * self.frequency * relative
