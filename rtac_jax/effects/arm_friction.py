"""Friction on the arm: asymmetric viscous (the paper's) and Coulomb."""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from rtac_jax._parameter import Scalar, parameter
from rtac_jax.effects._interface import DryFriction, Force, Motion, States


class ArmViscous(Force):
    """Viscous friction of the arm with one coefficient for each direction of rotation."""

    id: ClassVar[str] = "arm_viscous"
    equation: ClassVar[str] = "-K_v1 theta' for theta' > 0, -K_v2 theta' for theta' < 0"
    source: ClassVar[str] = "paper, equation (6)"
    port: ClassVar[str] = "arm"
    nature: ClassVar[str] = "dissipative"

    positive: Scalar = parameter(
        symbol="K_v1", unit="N m s/rad", bounds=(0.0, np.inf), meaning="viscous friction, forwards", null=0.0,
        source="paper, Table 1(b): 1.39e-4", plausible=lambda s: 0.05 * s.torque / s.arm_velocity,
    )  # fmt: skip
    negative: Scalar = parameter(
        symbol="K_v2", unit="N m s/rad", bounds=(0.0, np.inf), meaning="viscous friction, backwards", null=0.0,
        source="paper, Table 1(b): 1.49e-4", plausible=lambda s: 0.05 * s.torque / s.arm_velocity,
    )  # fmt: skip

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        coefficient = jnp.where(motion.arm_velocity > 0, self.positive, self.negative)
        return 0.0, -coefficient * motion.arm_velocity


class ArmCoulomb(DryFriction):
    """Dry friction in the bearings and brushes of the motor."""

    id: ClassVar[str] = "arm_coulomb"
    equation: ClassVar[str] = "-tau_c sgn theta'"
    source: ClassVar[str] = "Armstrong, Dupont and Canudas de Wit, Automatica 30 (1994)"
    port: ClassVar[str] = "arm"

    level: Scalar = parameter(
        symbol="tau_c", unit="N m", bounds=(0.0, np.inf), meaning="Coulomb friction of the arm", null=0.0,
        plausible=lambda s: 0.03 * s.torque,
    )  # fmt: skip

    def levels(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return 0.0, self.level
