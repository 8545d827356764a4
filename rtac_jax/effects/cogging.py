"""Cogging and ripple of the motor: torques that repeat with its angle, without current and in proportion to it."""

from typing import Any, ClassVar

from rtac_jax._sincos import sincos
from rtac_jax.effects._interface import Force, Motion, States
from rtac_jax.parameters import Scalar, parameter


class Cogging(Force):
    """A torque that repeats n times a turn, whether or not current flows."""

    id: ClassVar[str] = "cogging"
    equation: ClassVar[str] = "A sin(n theta + phi) = a sin(n theta) + b cos(n theta)"
    source: ClassVar[str] = "Hanselman, Brushless Permanent Magnet Motor Design (2006), chapter 3"
    port: ClassVar[str] = "arm"
    nature: ClassVar[str] = "conservative"

    sine: Scalar = parameter(symbol="a", unit="N m", meaning="A cos phi", null=0.0, plausible=lambda s: 0.03 * s.torque)
    cosine: Scalar = parameter(
        symbol="b", unit="N m", meaning="A sin phi", null=0.0, plausible=lambda s: 0.03 * s.torque
    )
    harmonic: Scalar = parameter(
        symbol="n", unit="1", meaning="periods in a turn", fixed=True,
        plausible=tuple(float(n) for n in range(2, 25)),
    )  # fmt: skip

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        s, c = sincos(self.harmonic * motion.arm_angle)
        return 0.0, self.sine * s + self.cosine * c


class SecondCogging(Cogging):
    """Another order of cogging: that of the slots beside that of the magnets, or the second harmonic of the first."""

    id: ClassVar[str] = "second_cogging"
    only_beside: ClassVar[tuple[str, ...]] = ("cogging",)


class TorqueRipple(Force):
    """A torque constant that rises and falls n times a turn; once a turn also where the angle of a commutated motor is off."""

    id: ClassVar[str] = "torque_ripple"
    equation: ClassVar[str] = "K_m i (a sin(n theta) + b cos(n theta))"
    source: ClassVar[str] = "Hanselman, Brushless Permanent Magnet Motor Design (2006), chapter 8"
    port: ClassVar[str] = "arm"
    nature: ClassVar[str] = "source"

    sine: Scalar = parameter(
        symbol="a", unit="1", meaning="ripple in phase with the sine, over the mean", null=0.0, plausible=0.05
    )
    cosine: Scalar = parameter(
        symbol="b", unit="1", meaning="ripple in phase with the cosine, over the mean", null=0.0, plausible=0.05
    )
    harmonic: Scalar = parameter(
        symbol="n", unit="1", meaning="periods in a turn", fixed=True,
        plausible=tuple(float(n) for n in range(1, 25)),
    )  # fmt: skip

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        s, c = sincos(self.harmonic * motion.arm_angle)
        return 0.0, motion.body.torque_constant * motion.current * (self.sine * s + self.cosine * c)
