"""A spring that remembers which way it was bent."""

from collections.abc import Mapping
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from rtac_jax.effects._interface import Force, Motion, States
from rtac_jax.parameters import Scalar, parameter


class HystereticSpring(Force):
    """A spring in parallel to the cart's that yields like many small sliders (Bouc-Wen with n = 1, beta = gamma).

    The state depends on the path of the cart but not on time, so it is known in closed form while the cart goes one
    way: it is straight until it changes sign and tends to the yield displacement from there. It starts at rest.
    """

    id: ClassVar[str] = "hysteretic_spring"
    equation: ClassVar[str] = "-k_h z, z' = q' - (|q'| z + q' |z|) / (2 z_y)"
    source: ClassVar[str] = "Wen, Journal of the Engineering Mechanics Division 102 (1976)"
    port: ClassVar[str] = "cart"
    nature: ClassVar[str] = "dissipative"
    states: ClassVar[dict[str, str]] = {"displacement": "m"}
    free_start: ClassVar[bool] = True
    closed: ClassVar[bool] = True

    stiffness: Scalar = parameter(
        symbol="k_h", unit="N/m", bounds=(0.0, np.inf), meaning="stiffness before it yields", null=0.0,
        plausible=lambda s: 0.1 * s.force / s.position,
    )  # fmt: skip
    yield_displacement: Scalar = parameter(
        symbol="z_y", unit="m", bounds=(0.0, np.inf), meaning="displacement at which it yields",
        plausible=lambda s: tuple(s.position * fraction for fraction in (0.05, 0.2, 0.6)),
    )  # fmt: skip

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return -self.stiffness * own[0], 0.0

    def start(self, motion: Motion) -> States:
        return (0.0 * motion.cart_position,)

    def unseen(self, extents: Mapping[str, tuple[float, float]]) -> str:
        low, high = extents.get("cart_position", (0.0, 0.0))
        yields, span = float(np.max(np.asarray(self.yield_displacement))), high - low
        if not 0 < span <= yields:
            return ""
        return (
            f"hysteretic_spring yields over {1e3 * yields:.3g} mm, and the cart moved over {1e3 * span:.3g} mm only: what was"
            " recorded is where it begins to yield, so its stiffness and the spring's are hardly told apart; record a wider motion."
        )

    def rate(self, motion: Motion, own: States) -> States:
        speed, z = motion.cart_velocity, own[0]
        return (speed - (jnp.abs(speed) * z + speed * jnp.abs(z)) / (2 * self.yield_displacement),)

    def follow(self, motion: Motion, own: States) -> States:
        path = motion.cart_position - motion.began.cart_position
        way = jnp.where(path < 0, -1.0, 1.0)
        ahead, path = way * own[0], way * path
        straight = jnp.clip(-ahead, 0.0, path)
        left = self.yield_displacement - ahead - straight
        return (way * (self.yield_displacement - left * jnp.exp((straight - path) / self.yield_displacement)),)
