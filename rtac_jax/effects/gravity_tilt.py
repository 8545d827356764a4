"""Gravity in a plane of motion that is not level."""

from typing import Any, ClassVar

import numpy as np

from rtac_jax._rigid_body import RigidBody
from rtac_jax.effects._interface import Force, Motion, States
from rtac_jax.parameters import Scalar, parameter

STANDARD_GRAVITY = 9.80665  # m/s^2, CGPM 1901

# An arm in a vertical plane has 1, and several times that where the model's eccentric_moment is too small.
_LARGEST = 10.0
_ROUNDED = 1e-3  # by which the sine of a vertical plane may be estimated beyond one


class GravityTilt(Force):
    """A tilt along the cart's travel and across it; the eccentric mass lies at q + e sin theta along, e cos theta across.

    Tilts are given by their sines: an arm in a vertical plane has 1 across. Where the position sensor was zeroed with the cart at
    rest, the cart's sag is in its zero: only the arm shows the tilt along.
    """

    id: ClassVar[str] = "gravity_tilt"
    equation: ClassVar[str] = "cart: (1 - z) (M+m) g a; arm: m e g (a cos theta - b sin theta)"
    source: ClassVar[str] = "potential -(M+m) g a q - m e g (a sin theta + b cos theta)"
    port: ClassVar[str] = "arm and cart"
    nature: ClassVar[str] = "conservative"

    along: Scalar = parameter(
        symbol="a", unit="1", meaning="sine of the tilt along the travel", null=0.0, plausible=0.01, largest=_LARGEST
    )
    across: Scalar = parameter(
        symbol="b", unit="1", meaning="sine of the tilt across the travel", null=0.0, plausible=0.01, largest=_LARGEST
    )
    zeroed: Scalar = parameter(
        symbol="z", unit="1", bounds=(0.0, 1.0), meaning="fraction of the cart's sag in the sensor's zero", fixed=True,
        plausible=(0.0, 1.0), default=0.0,
    )  # fmt: skip

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        body = motion.body
        pull = self.along * motion.cos_angle - self.across * motion.sin_angle
        return (
            (1.0 - self.zeroed) * body.total_mass * STANDARD_GRAVITY * self.along,
            body.eccentric_moment * STANDARD_GRAVITY * pull,
        )

    def remark(self, body: RigidBody) -> str:
        steepest = float(np.hypot(np.max(np.abs(self.along)), np.max(np.abs(self.across))))
        if steepest <= 1.0 + _ROUNDED:
            return ""
        swing = float(np.max(np.abs(body.eccentric_moment)))
        return (
            f"gravity_tilt of {steepest:.3g} is no sine: what is known is its product with eccentric_moment, which the model has "
            f"at {swing:.3g} kg m, a torque of {swing * STANDARD_GRAVITY * steepest:.3g} N m. Where the arm's plane is vertical, "
            f"eccentric_moment is {swing * steepest:.3g} kg m: give it in /rig, or, if another is given there, doubt that, or what "
            "fixes the torque's scale."
        )
