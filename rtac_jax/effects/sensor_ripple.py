"""Sensor errors that repeat with the measured quantity: once or several times in a turn, or along a pitch."""

from typing import Any, ClassVar

import numpy as np

from rtac_jax._sincos import sincos
from rtac_jax.effects._interface import Outputs, Sensor, States
from rtac_jax.parameters import Scalar, parameter


class TachoRipple(Sensor):
    """A tachometer scale that changes with the arm's angle: an eccentric rotor once a turn, commutator bars more often."""

    id: ClassVar[str] = "tacho_ripple"
    equation: ClassVar[str] = "theta' (1 + a sin(n theta) + b cos(n theta))"
    source: ClassVar[str] = "Doebelin, Measurement Systems (2004), section 4.5, ripple of a direct-current tachometer"
    needs_channel: ClassVar[str | None] = "arm_velocity"

    sine: Scalar = parameter(symbol="a", unit="1", meaning="relative ripple, sine", null=0.0, plausible=0.01)
    cosine: Scalar = parameter(symbol="b", unit="1", meaning="relative ripple, cosine", null=0.0, plausible=0.01)
    harmonic: Scalar = parameter(
        symbol="n", unit="1", meaning="periods in a turn", fixed=True,
        plausible=tuple(float(n) for n in range(1, 13)),
    )  # fmt: skip

    def read(self, outputs: Outputs, own: States) -> Outputs:
        s, c = sincos(self.harmonic * outputs.arm_angle)
        return outputs._replace(arm_velocity=outputs.arm_velocity * (1.0 + self.sine * s + self.cosine * c))


class EncoderRipple(Sensor):
    """An encoder error that repeats with the turn: an eccentric disc once, an oval one twice."""

    id: ClassVar[str] = "encoder_ripple"
    equation: ClassVar[str] = "theta + a sin(n theta) + b cos(n theta)"
    source: ClassVar[str] = "Doebelin, Measurement Systems (2004), section 4.3, eccentricity of a disc"
    needs_channel: ClassVar[str | None] = "arm_angle"

    sine: Scalar = parameter(symbol="a", unit="rad", meaning="ripple, sine", null=0.0, plausible=0.01)
    cosine: Scalar = parameter(symbol="b", unit="rad", meaning="ripple, cosine", null=0.0, plausible=0.01)
    harmonic: Scalar = parameter(
        symbol="n", unit="1", meaning="periods in a turn", fixed=True, plausible=(1.0, 2.0, 3.0, 4.0)
    )

    def read(self, outputs: Outputs, own: States) -> Outputs:
        s, c = sincos(self.harmonic * outputs.arm_angle)
        return outputs._replace(arm_angle=outputs.arm_angle + self.sine * s + self.cosine * c)


class LvdtRipple(Sensor):
    """An LVDT error that repeats along the travel with the pitch of the winding."""

    id: ClassVar[str] = "lvdt_ripple"
    equation: ClassVar[str] = "q + a sin(2 pi q / p) + b cos(2 pi q / p)"
    source: ClassVar[str] = "Doebelin, Measurement Systems (2004), section 4.3"
    needs_channel: ClassVar[str | None] = "cart_position"

    sine: Scalar = parameter(
        symbol="a", unit="m", meaning="ripple, sine", null=0.0, plausible=lambda s: 0.01 * s.position
    )
    cosine: Scalar = parameter(
        symbol="b", unit="m", meaning="ripple, cosine", null=0.0, plausible=lambda s: 0.01 * s.position
    )
    pitch: Scalar = parameter(
        symbol="p", unit="m", bounds=(0.0, np.inf), meaning="length of a period",
        plausible=lambda s: tuple(s.position * 0.25 * 2.0 ** (k / 4) for k in range(13)),
    )  # fmt: skip

    def read(self, outputs: Outputs, own: States) -> Outputs:
        q: Any = outputs.cart_position
        s, c = sincos(2 * np.pi * q / self.pitch)
        return outputs._replace(cart_position=q + self.sine * s + self.cosine * c)
