"""Rotor and arm apart: a shaft that twists, and a coupling with play. Motor and sensors of the arm sit on the rotor.

The arm's friction stays with the arm.
"""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from rtac_jax._numbers import Number
from rtac_jax._rigid_body import RigidBody
from rtac_jax.effects._interface import Force, Impact, Motion, Outputs, States
from rtac_jax.parameters import Scalar, parameter

FRICTION_ON_ARM = (
    "The arm's friction is taken to sit on the arm: of a motor that is braked by bearings of its own, or by a voltage that is held,"
    " the rotor's inertia and what damps the twist are others."
)
# Twists as fast as can be sampled, each 1.6 times as fast as the last, as a resonance shows within a third of its frequency.
_FASTER = (6.0, 10.0, 16.0, 25.0, 40.0, 64.0, 100.0, 160.0, 250.0)


def _rotor_share(grid: tuple[float, ...]) -> Any:
    return parameter(
        symbol="r", unit="1", bounds=(0.0, 0.95), meaning="fraction of the arm's inertia that is the rotor's",
        plausible=grid,
    )  # fmt: skip


class FlexibleShaft(Force):
    """A shaft of some compliance through which the rotor drives the arm; their twist has a resonance.

    With d the twist (rotor less arm), a = J / k_s and J_r = r J,
    J theta'' + J_r d'' = K_m i + ... and J_r theta'' + J_r d'' = K_m i - k_s d - damping.

    The compliance is the amplitude: at zero the shaft is rigid. A twist that is faster than `fastest` could not be
    sampled and would ask for tiny steps. So its own inertia, the factor of d'' in the second equation, is raised until
    it is no faster (mass scaling); the static twist stays right, and energy is still only lost.
    """

    id: ClassVar[str] = "flexible_shaft"
    equation: ClassVar[str] = "r J (theta'' + d'') = K_m i - k_s d - c_s d', J (1 - r) theta'' = k_s d + c_s d' + ..."
    source: ClassVar[str] = (
        "Leonhard, Control of Electrical Drives (2001), section 1.5; Belytschko (2014), mass scaling"
    )
    port: ClassVar[str] = "arm"
    nature: ClassVar[str] = "dissipative"
    states: ClassVar[dict[str, str]] = {"twist": "rad", "speed": "rad/s"}

    compliance: Scalar = parameter(
        symbol="J/k_s", unit="s^2", bounds=(0.0, np.inf), meaning="arm's inertia over the shaft's stiffness", null=0.0,
        plausible=lambda s: tuple(
            4.0 / (s.frequency * ratio) ** 2 for ratio in _FASTER if s.frequency * ratio < 0.8 / s.sample_time
        ),
    )  # fmt: skip
    rotor: Scalar = _rotor_share((0.5,))
    damping: Scalar = parameter(
        symbol="z_s", unit="1", bounds=(0.0, 1.0), meaning="damping ratio of the twist", plausible=0.05
    )
    fastest: Scalar = parameter(
        symbol="w_max", unit="rad/s", bounds=(0.0, np.inf), meaning="fastest twist that is followed", fixed=True,
        plausible=lambda s: 0.9 / s.sample_time,
    )  # fmt: skip

    def _sizes(self) -> tuple[Any, Any, Any]:
        """Return the twist's time scale squared, its inertia over its stiffness, and the fraction of the arm it carries."""
        square = jnp.maximum(self.compliance * self.rotor * (1.0 - self.rotor), self.fastest**-2.0)
        inertia = square + self.compliance * self.rotor**2
        return square, inertia, self.compliance * self.rotor / inertia

    def _accelerations(self, motion: Motion, own: States) -> tuple[Any, Any]:
        square, inertia, carried = self._sizes()
        rate = own[1] - carried * motion.arm_velocity
        pushed = self.compliance * motion.body.torque_constant * motion.current / motion.body.arm_inertia
        return rate, (pushed - own[0] - 2.0 * self.damping * jnp.sqrt(square) * rate) / inertia

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return 0.0, -self.rotor * motion.body.arm_inertia * self._accelerations(motion, own)[1]

    def arm_inertia(self, body: RigidBody) -> Any:
        return -self._sizes()[2] * self.rotor * body.arm_inertia

    def remark(self, body: RigidBody) -> str:
        del body
        return FRICTION_ON_ARM

    def start(self, motion: Motion) -> States:
        return 0.0 * motion.arm_angle, self._sizes()[2] * motion.arm_velocity

    def rate(self, motion: Motion, own: States) -> States:
        return self._accelerations(motion, own)

    def read(self, outputs: Outputs, own: States) -> Outputs:
        rate = own[1] - self._sizes()[2] * outputs.arm_velocity
        return outputs._replace(arm_velocity=outputs.arm_velocity + rate, arm_angle=outputs.arm_angle + own[0])


class Backlash(Impact):
    """A gap within which rotor and arm turn freely against each other; beyond it one pushes the other.

    A step is taken as if they were one; then the rotor gets what the motor gave it alone, until the gap is crossed, and
    what it gains the arm loses. They do not bounce. The gap starts in its middle.
    """

    id: ClassVar[str] = "backlash"
    equation: ClassVar[str] = "|d| <= b/2, r J (theta'' + d'') = K_m i - contact, J (1 - r) theta'' = contact + ..."
    source: ClassVar[str] = "Nordin and Gutman, Automatica 38 (2002); Moreau (1988) for impacts without bounce"
    port: ClassVar[str] = "arm"
    states: ClassVar[dict[str, str]] = {"twist": "rad", "rate": "rad/s"}

    gap: Scalar = parameter(
        symbol="b", unit="rad", bounds=(0.0, np.inf), meaning="play between rotor and arm", null=0.0, plausible=0.02
    )
    rotor: Scalar = _rotor_share((0.3,))

    def strike(self, motion: Motion, own: States, mobility: Number) -> tuple[States, Any, Any]:
        twist, rate = own
        began, step, inertia = motion.began, motion.step, self.rotor * motion.body.arm_inertia
        push = 0.5 * step * motion.body.torque_constant * (began.current + motion.current)
        gained = push / inertia - (motion.arm_velocity - began.arm_velocity)
        free = rate + gained / (1.0 - mobility * inertia)
        reached = twist + 0.5 * step * (rate + free)
        within = jnp.clip(reached, -0.5 * self.gap, 0.5 * self.gap)
        after = jnp.where(jnp.abs(reached) < 0.5 * self.gap, free, 0.0)
        return (within, after), -inertia * (after - rate), -inertia * (within - twist - step * rate)

    def remark(self, body: RigidBody) -> str:
        del body
        return FRICTION_ON_ARM

    def start(self, motion: Motion) -> States:
        return 0.0 * motion.arm_angle, 0.0 * motion.arm_velocity

    def read(self, outputs: Outputs, own: States) -> Outputs:
        return outputs._replace(arm_velocity=outputs.arm_velocity + own[1], arm_angle=outputs.arm_angle + own[0])
