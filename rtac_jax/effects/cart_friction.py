"""Friction on the cart: viscous and Coulomb (the paper's), Stribeck, by direction, and quadratic drag."""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from rtac_jax.effects._interface import DryFriction, Force, Motion, States
from rtac_jax.parameters import Scalar, parameter


class CartViscous(Force):
    """Air friction and spring damping, proportional to the cart's velocity."""

    id: ClassVar[str] = "cart_viscous"
    equation: ClassVar[str] = "-v q'"
    source: ClassVar[str] = "paper, section 4.1"
    port: ClassVar[str] = "cart"
    nature: ClassVar[str] = "dissipative"

    coefficient: Scalar = parameter(
        symbol="v", unit="N s/m", bounds=(0.0, np.inf), meaning="viscous friction of the cart", null=0.0,
        source="paper, section 4.2: 0.5543", plausible=lambda s: 0.05 * s.force / s.velocity,
    )  # fmt: skip

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return -self.coefficient * motion.cart_velocity, 0.0


class CartCoulomb(DryFriction):
    """Dry friction of the cart, the same at all speeds."""

    id: ClassVar[str] = "cart_coulomb"
    equation: ClassVar[str] = "-d sgn q'"
    source: ClassVar[str] = "paper, section 4.1"
    port: ClassVar[str] = "cart"

    level: Scalar = parameter(
        symbol="d", unit="N", bounds=(0.0, np.inf), meaning="Coulomb friction of the cart", null=0.0,
        source="paper, section 4.2: 0.024", plausible=lambda s: 0.02 * s.force,
    )  # fmt: skip

    def levels(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return self.level, 0.0


class CartStribeck(DryFriction):
    """Dry friction of the cart that is larger near rest."""

    id: ClassVar[str] = "cart_stribeck"
    equation: ClassVar[str] = "-f exp(-(q' / v_s)^2) sgn q'"
    contains: ClassVar[tuple[str, ...]] = ("cart_coulomb",)
    presupposes: ClassVar[tuple[str, ...]] = ("cart_coulomb",)
    source: ClassVar[str] = "Armstrong, Dupont and Canudas de Wit, Automatica 30 (1994)"
    port: ClassVar[str] = "cart"

    level: Scalar = parameter(
        symbol="f", unit="N", bounds=(0.0, np.inf), meaning="dry friction of the cart near rest", null=0.0,
        plausible=lambda s: 0.03 * s.force,
    )  # fmt: skip
    velocity: Scalar = parameter(
        symbol="v_s", unit="m/s", bounds=(0.0, np.inf), meaning="velocity at which it has fallen to 37 %",
        plausible=lambda s: tuple(s.velocity * fraction for fraction in (0.05, 0.15, 0.5)),
    )  # fmt: skip

    def levels(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return self.level * jnp.exp(-((motion.cart_velocity / self.velocity) ** 2)), 0.0


class CartAsymmetricFriction(Force):
    """Viscous friction of the cart that is larger one way than the other, as of a screw or a belt; by half of the difference.

    Dry friction that differs by direction is `force_offset` beside `cart_coulomb` while the cart slides.
    """

    id: ClassVar[str] = "cart_asymmetric_friction"
    equation: ClassVar[str] = "-a |q'|"
    source: ClassVar[str] = (
        "Armstrong, Dupont and Canudas de Wit, Automatica 30 (1994), section 2; of the arm: paper, section 4.1"
    )
    port: ClassVar[str] = "cart"
    nature: ClassVar[str] = "source"  # by itself; beside `cart_viscous` it takes energy out both ways

    coefficient: Scalar = parameter(
        symbol="a", unit="N s/m", meaning="half of what the viscous friction is larger forwards than backwards", null=0.0,
        plausible=lambda s: 0.02 * s.force / s.velocity,
    )  # fmt: skip

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return -self.coefficient * jnp.abs(motion.cart_velocity), 0.0


class CartQuadraticDrag(Force):
    """Drag of turbulent air, proportional to the square of the cart's velocity."""

    id: ClassVar[str] = "cart_quadratic_drag"
    equation: ClassVar[str] = "-c |q'| q'"
    source: ClassVar[str] = "Nayfeh and Mook, Nonlinear Oscillations (1979), section 3.3"
    port: ClassVar[str] = "cart"
    nature: ClassVar[str] = "dissipative"

    coefficient: Scalar = parameter(
        symbol="c", unit="N s^2/m^2", bounds=(0.0, np.inf), meaning="quadratic drag of the cart", null=0.0,
        plausible=lambda s: 0.02 * s.force / s.velocity**2,
    )  # fmt: skip

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return -self.coefficient * jnp.abs(motion.cart_velocity) * motion.cart_velocity, 0.0
