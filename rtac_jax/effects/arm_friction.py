"""Friction on the arm: asymmetric viscous (the paper's), Coulomb, Stribeck, by load, and quadratic drag."""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from rtac_jax._rigid_body import RigidBody
from rtac_jax.effects._interface import DryFriction, Force, Motion, States
from rtac_jax.parameters import Scalar, parameter


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


class ArmStribeck(DryFriction):
    """Dry friction of the arm that is larger near rest: grease and brushes that stick."""

    id: ClassVar[str] = "arm_stribeck"
    equation: ClassVar[str] = "-tau_s exp(-(theta' / w_s)^2) sgn theta'"
    contains: ClassVar[tuple[str, ...]] = ("arm_coulomb",)
    presupposes: ClassVar[tuple[str, ...]] = ("arm_coulomb",)
    source: ClassVar[str] = "Armstrong, Dupont and Canudas de Wit, Automatica 30 (1994)"
    port: ClassVar[str] = "arm"

    level: Scalar = parameter(
        symbol="tau_s", unit="N m", bounds=(0.0, np.inf), meaning="dry friction of the arm near rest", null=0.0,
        plausible=lambda s: 0.05 * s.torque,
    )  # fmt: skip
    velocity: Scalar = parameter(
        symbol="w_s", unit="rad/s", bounds=(0.0, np.inf), meaning="velocity at which it has fallen to 37 %",
        plausible=lambda s: tuple(s.arm_velocity * fraction for fraction in (0.05, 0.15, 0.5)),
    )  # fmt: skip

    def levels(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return 0.0, self.level * jnp.exp(-((motion.arm_velocity / self.velocity) ** 2))


class ArmLoadFriction(DryFriction):
    """Dry friction of a gear, which grows with the torque that the motor passes on through its teeth.

    At one sign of current and rotation alone it is a smaller torque constant.
    """

    id: ClassVar[str] = "arm_load_friction"
    equation: ClassVar[str] = "-mu |K_m i| sgn theta'"
    source: ClassVar[str] = "Hamon, Gautier and Garrec, IEEE/RSJ Int. Conf. Intelligent Robots and Systems (2010)"
    port: ClassVar[str] = "arm"

    fraction: Scalar = parameter(
        symbol="mu", unit="1", bounds=(0.0, 1.0), meaning="dry friction for each unit of the motor's torque", null=0.0,
        plausible=lambda _: 0.1,
    )  # fmt: skip

    def remark(self, body: RigidBody) -> str:
        driving, braking = (float(np.mean(body.torque_constant * (1.0 + sign * self.fraction))) for sign in (-1, 1))
        return (
            f"What acts is {driving:.4g} N m/A while the motor drives and {braking:.4g} while it brakes: a gear that rubs "
            "otherwise while it brakes is the same with another torque constant."
        )

    def levels(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return 0.0, self.fraction * jnp.abs(motion.body.torque_constant * motion.current)


class ArmQuadraticDrag(Force):
    """Drag of turbulent air on the turning arm."""

    id: ClassVar[str] = "arm_quadratic_drag"
    equation: ClassVar[str] = "-c |theta'| theta'"
    source: ClassVar[str] = "Nayfeh and Mook, Nonlinear Oscillations (1979), section 3.3"
    port: ClassVar[str] = "arm"
    nature: ClassVar[str] = "dissipative"

    coefficient: Scalar = parameter(
        symbol="c", unit="N m s^2/rad^2", bounds=(0.0, np.inf), meaning="quadratic drag of the arm", null=0.0,
        plausible=lambda s: 0.03 * s.torque / s.arm_velocity**2,
    )  # fmt: skip

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return 0.0, -self.coefficient * jnp.abs(motion.arm_velocity) * motion.arm_velocity
