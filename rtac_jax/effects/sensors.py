"""What may stand between the motion and what is recorded of it."""

from typing import ClassVar

from rtac_jax._parameter import Scalar, parameter
from rtac_jax.effects._interface import Outputs, Sensor, States


class TachoBias(Sensor):
    """A constant in the tachometer's reading; integrated, it drifts."""

    id: ClassVar[str] = "tacho_bias"
    equation: ClassVar[str] = "theta' + b"
    source: ClassVar[str] = "offset of an analogue amplifier"

    bias: Scalar = parameter(
        symbol="b", unit="rad/s", meaning="tachometer reading at rest", null=0.0,
        plausible=lambda s: 0.02 * s.arm_velocity,
    )  # fmt: skip

    def read(self, outputs: Outputs, own: States) -> Outputs:
        return outputs._replace(arm_velocity=outputs.arm_velocity + self.bias)
