"""Springs of the cart that are not linear, a spring of the arm, and a constant force and torque that move their equilibria."""

from collections.abc import Mapping
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from rtac_jax.effects._interface import Force, Motion, States
from rtac_jax.parameters import Scalar, parameter

_SHORT_OF_IT = 0.9  # of the travel, below which an end was not touched whatever a sensor's offset or gain makes of it


class CubicSpring(Force):
    """A spring that hardens (k_3 > 0) or softens (k_3 < 0) alike on both sides."""

    id: ClassVar[str] = "cubic_spring"
    equation: ClassVar[str] = "-k_3 q^3"
    source: ClassVar[str] = "Duffing; Nayfeh and Mook, Nonlinear Oscillations (1979), section 4.1"
    port: ClassVar[str] = "cart"
    nature: ClassVar[str] = "conservative"

    stiffness: Scalar = parameter(
        symbol="k_3", unit="N/m^3", meaning="cubic stiffness", null=0.0,
        plausible=lambda s: 0.02 * s.force / s.position**3,
    )  # fmt: skip

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return -self.stiffness * motion.cart_position**3, 0.0


class QuadraticSpring(Force):
    """A spring that is stiffer on one side than on the other."""

    id: ClassVar[str] = "quadratic_spring"
    equation: ClassVar[str] = "-k_2 q^2"
    source: ClassVar[str] = "Nayfeh and Mook, Nonlinear Oscillations (1979), section 2.3"
    port: ClassVar[str] = "cart"
    nature: ClassVar[str] = "conservative"

    stiffness: Scalar = parameter(
        symbol="k_2", unit="N/m^2", meaning="quadratic stiffness", null=0.0,
        plausible=lambda s: 0.02 * s.force / s.position**2,
    )  # fmt: skip

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return -self.stiffness * motion.cart_position**2, 0.0


class ForceOffset(Force):
    """A constant force: an offset of the force input, or a spring whose rest is not at the position sensor's zero."""

    id: ClassVar[str] = "force_offset"
    # On a linear spring the same as a zero of the sensor beside the spring's rest.
    resembles: ClassVar[tuple[str, ...]] = ("lvdt_offset",)
    equation: ClassVar[str] = "F_0"
    source: ClassVar[str] = "offset of an analogue amplifier"
    port: ClassVar[str] = "cart"
    nature: ClassVar[str] = "conservative"

    offset: Scalar = parameter(
        symbol="F_0", unit="N", meaning="constant force on the cart", null=0.0, plausible=lambda s: 0.03 * s.force
    )

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return self.offset, 0.0


class TorqueOffset(Force):
    """A constant torque on the arm where nothing drives it: an idle drive that does not command zero, or a soft cable.

    Where a current is played it is the same as `current_offset`, which stands for it there.
    """

    id: ClassVar[str] = "torque_offset"
    equation: ClassVar[str] = "tau_0"
    source: ClassVar[str] = "offset of an analogue current loop"
    port: ClassVar[str] = "arm"
    nature: ClassVar[str] = "conservative"
    undriven: ClassVar[bool] = True

    offset: Scalar = parameter(
        symbol="tau_0", unit="N m", meaning="constant torque on the arm", null=0.0, plausible=lambda s: 0.03 * s.torque
    )

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return 0.0, self.offset


class EndStop(Force):
    """A stiff stop at both ends of the travel, alike and elastic."""

    id: ClassVar[str] = "end_stop"
    equation: ClassVar[str] = "-k_s (q - clip(q, -a, a))"
    source: ClassVar[str] = "Shaw and Holmes, Journal of Sound and Vibration 90 (1983), piecewise linear oscillator"
    port: ClassVar[str] = "cart"
    nature: ClassVar[str] = "conservative"

    stiffness: Scalar = parameter(
        symbol="k_s", unit="N/m", bounds=(0.0, np.inf), meaning="stiffness of the stop", null=0.0,
        plausible=lambda s: 3.0 * s.force / s.position,
    )  # fmt: skip
    travel: Scalar = parameter(
        symbol="a", unit="m", bounds=(0.0, np.inf), meaning="travel to each side before the stop is touched",
        plausible=lambda s: tuple(s.position * fraction for fraction in (1.0, 1.3, 1.7, 2.2, 3.0)),
    )  # fmt: skip

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        beyond = motion.cart_position - jnp.clip(motion.cart_position, -self.travel, self.travel)
        return -self.stiffness * beyond, 0.0

    def unseen(self, extents: Mapping[str, tuple[float, float]]) -> str:
        low, high = extents.get("cart_position", (0.0, 0.0))
        touched, other = ("positive", -low) if high > -low else ("negative", high)
        if max(high, -low) <= self.travel or other >= _SHORT_OF_IT * self.travel:
            return ""
        return (
            f"end_stop was touched at {touched} positions only: the other way the cart went no farther than"
            f" {1e3 * max(other, 0.0):.3g} mm. That the stop there is alike is assumed; record a run that reaches it."
        )


class CableSpring(Force):
    """A cable or hose that leads to the arm and winds up; its home angle is tau_0 / k_c.

    With the stiffness at zero it is a constant torque, the same as `current_offset` or, undriven, `torque_offset`.
    """

    id: ClassVar[str] = "cable_spring"
    contains: ClassVar[tuple[str, ...]] = ("current_offset", "torque_offset")
    equation: ClassVar[str] = "-k_c (theta - theta_home) = -k_c theta + tau_0"
    source: ClassVar[str] = "torsion of a round bar; Timoshenko, Strength of Materials I (1955), chapter 10"
    port: ClassVar[str] = "arm"
    nature: ClassVar[str] = "conservative"
    most_turns: ClassVar[float] = 10.0

    stiffness: Scalar = parameter(
        symbol="k_c", unit="N m/rad", bounds=(0.0, np.inf), meaning="stiffness of the cable", null=0.0,
        plausible=lambda s: 0.03 * s.torque,
    )  # fmt: skip
    torque: Scalar = parameter(
        symbol="tau_0", unit="N m", meaning="torque of the cable at theta = 0", null=0.0,
        plausible=lambda s: 0.03 * s.torque,
    )  # fmt: skip

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        return 0.0, self.torque - self.stiffness * motion.arm_angle
