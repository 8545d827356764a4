"""Equations (1) and (2) of the paper: a cart on a spring, carrying an arm with an eccentric mass."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from rtac_jax._numbers import Number
from rtac_jax.parameters import Scalar, parameter

_TABLE_1 = "paper, Table 1(c)"
RIGID_STATES = {"cart_position": "m", "cart_velocity": "m/s", "arm_angle": "rad", "arm_velocity": "rad/s"}


class RigidBody(eqx.Module):
    """The cart, spring, motor and arm without any friction.

    (M+m) q'' + k q = -m e (theta'' cos theta - theta'^2 sin theta) + F        (1)
    (I+m e^2) theta'' = -m e q'' cos theta + K_m i                            (2)

    Raises:
        ValueError: a mass, an inertia or a motor constant is not positive, the stiffness is negative, or the mass matrix is not
            positive definite.
    """

    total_mass: Scalar = parameter(
        symbol="M+m", unit="kg", bounds=(0.0, np.inf), meaning="cart and arm together", source=_TABLE_1
    )
    arm_inertia: Scalar = parameter(
        symbol="I+me^2", unit="kg m^2", bounds=(0.0, np.inf), meaning="arm about the motor axis", source=_TABLE_1
    )
    eccentric_moment: Scalar = parameter(
        symbol="me",
        unit="kg m",
        bounds=(0.0, np.inf),
        meaning="arm mass times eccentricity",
        source="paper, Table 1(b)",
    )
    spring_stiffness: Scalar = parameter(
        symbol="k", unit="N/m", bounds=(0.0, np.inf), meaning="spring of the cart", source=_TABLE_1,
        plausible=lambda s: 0.01 * s.force / s.position,
    )  # fmt: skip
    torque_constant: Scalar = parameter(
        symbol="K_m", unit="N m/A", bounds=(0.0, np.inf), meaning="motor torque per ampere", source=_TABLE_1
    )

    def __check_init__(self) -> None:
        for name in ("total_mass", "arm_inertia", "spring_stiffness", "torque_constant"):
            value = getattr(self, name)
            # A slide has no spring.
            if _is_concrete(value) and not np.all(
                (np.asarray(value) > 0) | (name == "spring_stiffness") & (value == 0)
            ):
                raise ValueError(f"{name} is {np.asarray(value)}, but must be positive.")
        values = (self.total_mass, self.arm_inertia, self.eccentric_moment)
        if all(_is_concrete(value) for value in values) and not np.all(
            np.square(np.asarray(values[2])) < np.asarray(values[0]) * np.asarray(values[1])
        ):
            raise ValueError(
                f"eccentric_moment is {np.asarray(self.eccentric_moment)}, but its square must be below "
                "total_mass times arm_inertia, or the mass matrix is not positive definite."
            )

    @classmethod
    def as_fitted(cls, **values: Number) -> "RigidBody":
        """Return a body whose eccentric moment may be larger than its inertia allows, as a fit where something is missing ends.

        Args:
            values: of all parameters.

        Raises:
            TypeError: one is missing.
            ValueError: a mass, an inertia or a stiffness is not positive, or the moment is no finite number.
        """
        moment = values.pop("eccentric_moment", None)
        if moment is None or not np.all(np.isfinite(np.asarray(moment, dtype=float))):
            raise ValueError(f"eccentric_moment is {moment}, but must be finite.")
        return eqx.tree_at(lambda body: body.eccentric_moment, cls(**values, eccentric_moment=0.0), moment)

    def coupling(self) -> Any:
        """Return epsilon = m e / sqrt((I+m e^2)(M+m)), equation (3); no unit."""
        return self.eccentric_moment / jnp.sqrt(self.arm_inertia * self.total_mass)

    def natural_frequency(self) -> Any:
        """Return the natural frequency sqrt(k / (M+m)) [rad/s]."""
        return jnp.sqrt(self.spring_stiffness / self.total_mass)

    def energy(self, cart_position: Number, cart_velocity: Number, arm_angle: Number, arm_velocity: Number) -> Any:
        """Return kinetic and spring energy [J]."""
        kinetic_cart = 0.5 * self.total_mass * cart_velocity**2
        kinetic_arm = 0.5 * self.arm_inertia * arm_velocity**2
        exchange = self.eccentric_moment * cart_velocity * arm_velocity * jnp.cos(arm_angle)
        return kinetic_cart + kinetic_arm + exchange + 0.5 * self.spring_stiffness * cart_position**2


def _is_concrete(value: object) -> bool:
    return isinstance(value, jnp.ndarray) and not hasattr(value, "_trace") and hasattr(value, "__array__")
