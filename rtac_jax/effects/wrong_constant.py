"""Wrong constants: what a rig has more of than the constant says that was known of it beforehand.

They are no part of the rig, so they are not in the catalogue. A diagnosis offers them beside it for constants that a model takes
as exact: an inertia that is wrong by half a percent looks like a gain of a sensor that is wrong by a quarter.
"""

from typing import Any, ClassVar

import numpy as np

from rtac_jax._rigid_body import RigidBody
from rtac_jax.effects._interface import Force, Motion, States
from rtac_jax.parameters import Scalar, parameter

# A heavier cart swings slower until its spring follows: at a percent that outweighs the rest, at 1e-4 it is a hundredth of it.
_LOOKED_AT = 1e-2


def _error(of: str) -> Any:
    return parameter(
        symbol="g", unit="1", bounds=(-0.9, np.inf), meaning=f"relative error of the {of}", null=0.0, plausible=0.01
    )


class _WrongConstant(Force):
    """More or less of a constant than was known of it beforehand; no force but where the constant makes one."""

    source: ClassVar[str] = "weighing, or a bifilar test, of the rig itself"
    nature: ClassVar[str] = "conservative"
    resembles: ClassVar[tuple[str, ...]] = ("lvdt_gain",)
    looked_at: ClassVar[float] = _LOOKED_AT

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return 0.0, 0.0


class WrongTotalMass(_WrongConstant):
    """A cart with its arm that is heavier or lighter than it was weighed."""

    id: ClassVar[str] = "wrong_total_mass"
    equation: ClassVar[str] = "M + m + dM"
    port: ClassVar[str] = "cart"

    missing: Scalar = parameter(
        symbol="dM", unit="kg", meaning="mass beyond the constant", null=0.0, plausible=lambda s: 0.01 * s.mass
    )

    def cart_mass(self) -> Any:
        return self.missing


class WrongArmInertia(_WrongConstant):
    """An arm whose inertia about its axis is not the constant."""

    id: ClassVar[str] = "wrong_arm_inertia"
    equation: ClassVar[str] = "(1 + g) J"
    port: ClassVar[str] = "arm"

    error: Scalar = _error("arm's inertia")

    def arm_inertia(self, body: RigidBody) -> Any:
        return self.error * body.arm_inertia


class WrongSpringStiffness(_WrongConstant):
    """A spring whose stiffness is not the constant."""

    id: ClassVar[str] = "wrong_spring_stiffness"
    equation: ClassVar[str] = "-g k q"
    port: ClassVar[str] = "cart"

    error: Scalar = _error("spring's stiffness")

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return -self.error * motion.body.spring_stiffness * motion.cart_position, 0.0


class WrongTorqueConstant(_WrongConstant):
    """A motor whose torque for each ampere is not the constant."""

    id: ClassVar[str] = "wrong_torque_constant"
    equation: ClassVar[str] = "g K_m i"
    port: ClassVar[str] = "actuator"
    nature: ClassVar[str] = "source"

    error: Scalar = _error("torque constant")

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return 0.0, self.error * motion.body.torque_constant * motion.current


WRONG_CONSTANTS: dict[str, type[Force]] = {
    "total_mass": WrongTotalMass,
    "arm_inertia": WrongArmInertia,
    "spring_stiffness": WrongSpringStiffness,
    "torque_constant": WrongTorqueConstant,
}
"""By the constant's name."""
