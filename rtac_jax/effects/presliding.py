"""Dry friction by bristles: what is stuck yields a little before it slides (Dahl), for the cart and for the arm."""

from abc import abstractmethod
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from rtac_jax._numbers import Number
from rtac_jax.effects._interface import Force, Motion, States
from rtac_jax.parameters import Scalar, parameter


def _bend(bent: Number, speed: Number, yields_at: Number) -> Any:
    """Return how fast bristles bend that are bent so far, at this speed."""
    return speed - jnp.abs(speed) * bent / yields_at


def _bent(bent: Number, path: Number, yields_at: Number) -> Any:
    """Return how far bristles are bent after a path without a turn, from where they were bent at its beginning."""
    end = jnp.where(path < 0, -yields_at, yields_at)
    return end - (end - bent) * jnp.exp(-jnp.abs(path) / yields_at)


class _Presliding(Force):
    """Dry friction by bristles, which depends on the path but not on time: known in closed form while it leads one way."""

    source: ClassVar[str] = "Dahl, Aerospace Corporation TOR-0158 (1968); Canudas de Wit and others, IEEE TAC 40 (1995)"
    nature: ClassVar[str] = "dissipative"
    free_start: ClassVar[bool] = True
    closed: ClassVar[bool] = True
    place: ClassVar[str]
    speed: ClassVar[str]

    @abstractmethod
    def yields_at(self) -> Any:
        """Return the deflection at which stuck bristles yield."""

    def start(self, motion: Motion) -> States:
        return (0.0 * getattr(motion, self.place),)

    def reach(self) -> States:
        return (self.yields_at(),)

    def rate(self, motion: Motion, own: States) -> States:
        return (_bend(own[0], getattr(motion, self.speed), self.yields_at()),)

    def follow(self, motion: Motion, own: States) -> States:
        path = getattr(motion, self.place) - getattr(motion.began, self.place)
        return (_bent(own[0], path, self.yields_at()),)


class CartPresliding(_Presliding):
    """Dry friction of the cart whose bearings yield before they slide; beside it there is no other dry friction left, as a rule.

    A hysteretic spring is much alike, but wider.
    """

    id: ClassVar[str] = "cart_presliding"
    equation: ClassVar[str] = "-f z / z_y, z' = q' - |q'| z / z_y"
    contains: ClassVar[tuple[str, ...]] = ("cart_coulomb",)
    edge: ClassVar[tuple[str, str] | None] = ("displacement", "cart_position")
    port: ClassVar[str] = "cart"
    states: ClassVar[dict[str, str]] = {"deflection": "m"}
    place: ClassVar[str] = "cart_position"
    speed: ClassVar[str] = "cart_velocity"

    level: Scalar = parameter(
        symbol="f", unit="N", bounds=(0.0, np.inf), meaning="friction of the cart when it slides", null=0.0,
        plausible=lambda s: 0.03 * s.force,
    )  # fmt: skip
    displacement: Scalar = parameter(
        symbol="z_y", unit="m", bounds=(0.0, np.inf), meaning="displacement over which stuck bristles yield",
        plausible=lambda s: tuple(s.position * fraction for fraction in (0.01, 0.1)),
    )  # fmt: skip

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return -self.level * own[0] / self.displacement, 0.0

    def yields_at(self) -> Any:
        return self.displacement


class ArmPresliding(_Presliding):
    """Dry friction of the arm whose bearings and brushes yield before they slide."""

    id: ClassVar[str] = "arm_presliding"
    equation: ClassVar[str] = "-tau z / z_y, z' = theta' - |theta'| z / z_y"
    contains: ClassVar[tuple[str, ...]] = ("arm_coulomb",)
    edge: ClassVar[tuple[str, str] | None] = ("angle", "arm_angle")
    port: ClassVar[str] = "arm"
    states: ClassVar[dict[str, str]] = {"deflection": "rad"}
    place: ClassVar[str] = "arm_angle"
    speed: ClassVar[str] = "arm_velocity"

    level: Scalar = parameter(
        symbol="tau", unit="N m", bounds=(0.0, np.inf), meaning="friction of the arm when it slides", null=0.0,
        plausible=lambda s: 0.03 * s.torque,
    )  # fmt: skip
    angle: Scalar = parameter(
        symbol="z_y", unit="rad", bounds=(0.0, np.inf), meaning="angle over which stuck bristles yield",
        plausible=lambda s: tuple(s.arm_velocity / s.frequency * fraction for fraction in (0.01, 0.1)),
    )  # fmt: skip

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return 0.0, -self.level * own[0] / self.angle

    def yields_at(self) -> Any:
        return self.angle
