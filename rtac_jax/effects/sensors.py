"""Sensor effects, between the motion and what is recorded of it, however the sensor works: gain, offset, lag, delay.

A lag's state is how far the sensor shows more than there is. So it is zero where there is no lag, and a random force
that moves the rig is seen at once, as it should be through a lag that vanishes.
"""

from abc import abstractmethod
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from rtac_jax._numbers import Number
from rtac_jax.effects._interface import Motion, Outputs, Sensor, States
from rtac_jax.effects._lag import behind
from rtac_jax.parameters import Scalar, parameter

_AMPLIFIER = "gain and offset of an analogue amplifier; Doebelin, Measurement Systems (2004), chapter 3"
_PADE = "Golub and Van Loan, Matrix Computations (2013), section 9.3, Pade approximation of exp"
_FIRST_ORDER = "first-order instrument; Doebelin, Measurement Systems (2004), chapter 3"


def _gain(reads: str) -> Any:
    return parameter(
        symbol="g", unit="1", bounds=(-0.9, np.inf), meaning=f"relative error of the {reads}", null=0.0, plausible=0.03
    )


def _late(meaning: str, samples: float) -> Any:
    return parameter(
        symbol="tau", unit="s", bounds=(0.0, np.inf), meaning=meaning, null=0.0,
        plausible=lambda s: samples * s.sample_time,
    )  # fmt: skip


def _lag_rate(time_constant: Number, ahead: Number, speed: Number) -> States:
    acts = time_constant > 0
    return (jnp.where(acts, -ahead / jnp.where(acts, time_constant, 1.0) - speed, 0.0),)


class _LatePosition(Sensor):
    """A position or an angle that is read late: the output that the effect needs, and the velocity that changes it."""

    closed: ClassVar[bool] = True
    place: ClassVar[str]
    speed: ClassVar[str]

    @abstractmethod
    def lag(self) -> Any:
        """Return the time constant of the lag [s]."""

    def read(self, outputs: Outputs, own: States) -> Outputs:
        return outputs._replace(**{self.place: getattr(outputs, self.place) + own[0]})

    def start(self, motion: Motion) -> States:
        return (-self.lag() * getattr(motion, self.speed),)

    def rate(self, motion: Motion, own: States) -> States:
        return _lag_rate(self.lag(), own[0], getattr(motion, self.speed))

    def follow(self, motion: Motion, own: States) -> States:
        change = getattr(motion, self.place) - getattr(motion.began, self.place)
        bend = 0.5 * motion.step * (getattr(motion, self.speed) - getattr(motion.began, self.speed))
        return (behind(own[0], self.lag() / motion.step, change, bend),)


class _LateVelocity(Sensor):
    """An arm velocity that is read late."""

    closed: ClassVar[bool] = True

    @abstractmethod
    def lag(self) -> Any:
        """Return the time constant of the lag [s]."""

    def read(self, outputs: Outputs, own: States) -> Outputs:
        return outputs._replace(arm_velocity=outputs.arm_velocity + own[0])

    def start(self, motion: Motion) -> States:
        return (0.0 * motion.arm_velocity,)

    def rate(self, motion: Motion, own: States) -> States:
        return _lag_rate(self.lag(), own[0], motion.arm_acceleration)

    def follow(self, motion: Motion, own: States) -> States:
        change = motion.arm_velocity - motion.began.arm_velocity
        return (behind(own[0], self.lag() / motion.step, change),)


class TachoGain(Sensor):
    """A wrong scale of the tachometer. It shows because the arm's angle acts on the cart through its sine and cosine."""

    id: ClassVar[str] = "tacho_gain"
    equation: ClassVar[str] = "(1 + g) theta'"
    source: ClassVar[str] = _AMPLIFIER
    needs_channel: ClassVar[str | None] = "arm_velocity"

    error: Scalar = _gain("tachometer's scale")

    def read(self, outputs: Outputs, own: States) -> Outputs:
        return outputs._replace(arm_velocity=outputs.arm_velocity * (1.0 + self.error))


class TachoBias(Sensor):
    """A constant in the tachometer's reading; integrated, it drifts."""

    id: ClassVar[str] = "tacho_bias"
    equation: ClassVar[str] = "theta' + b"
    source: ClassVar[str] = "offset of an analogue amplifier"
    needs_channel: ClassVar[str | None] = "arm_velocity"

    bias: Scalar = parameter(
        symbol="b", unit="rad/s", meaning="tachometer reading at rest", null=0.0,
        plausible=lambda s: 0.02 * s.arm_velocity,
    )  # fmt: skip

    def read(self, outputs: Outputs, own: States) -> Outputs:
        return outputs._replace(arm_velocity=outputs.arm_velocity + self.bias)


class TachoLag(_LateVelocity):
    """A first-order lag of the tachometer's filter behind the arm's velocity."""

    id: ClassVar[str] = "tacho_lag"
    equation: ClassVar[str] = "tau y' = theta' - y"
    source: ClassVar[str] = _FIRST_ORDER
    needs_channel: ClassVar[str | None] = "arm_velocity"
    resembles: ClassVar[tuple[str, ...]] = ("tacho_delay",)
    states: ClassVar[dict[str, str]] = {"ahead": "rad/s"}

    time_constant: Scalar = _late("time constant of the tachometer", 2.0)

    def lag(self) -> Any:
        return self.time_constant


class TachoDelay(_LateVelocity):
    """An arm velocity that is read late: counted over a window, or behind a filter of second order or more.

    A count over a window of T is late by T / 2, and a Butterworth filter of second order by 0.225 over its cut-off in hertz; below
    a third of the cut-off neither does more. The delay is Pade's approximation of first order, as that of `channel_delay`.
    """

    id: ClassVar[str] = "tacho_delay"
    equation: ClassVar[str] = "theta'(t - tau)"
    source: ClassVar[str] = _PADE
    needs_channel: ClassVar[str | None] = "arm_velocity"
    resembles: ClassVar[tuple[str, ...]] = ("tacho_lag",)
    states: ClassVar[dict[str, str]] = {"ahead": "rad/s"}

    delay: Scalar = _late("delay of the arm's velocity", 1.0)

    def lag(self) -> Any:
        return 0.5 * self.delay

    def read(self, outputs: Outputs, own: States) -> Outputs:
        return outputs._replace(arm_velocity=outputs.arm_velocity + 2.0 * own[0])


class LvdtGain(Sensor):
    """A wrong scale of the LVDT.

    To be told from the other parameters it needs a second scale for the cart: with the arm free, the eccentric moment,
    the total mass or the disturbance force have to be known.
    """

    id: ClassVar[str] = "lvdt_gain"
    equation: ClassVar[str] = "(1 + g) q"
    source: ClassVar[str] = _AMPLIFIER
    needs_channel: ClassVar[str | None] = "cart_position"
    resembles: ClassVar[tuple[str, ...]] = ("wrong_arm_inertia", "wrong_total_mass")

    error: Scalar = _gain("LVDT's scale")

    def read(self, outputs: Outputs, own: States) -> Outputs:
        return outputs._replace(cart_position=outputs.cart_position * (1.0 + self.error))


class LvdtOffset(Sensor):
    """An LVDT whose zero is not where the spring is at rest.

    On a linear spring it is the same as `force_offset`; only a spring that is not linear can tell them apart.
    """

    id: ClassVar[str] = "lvdt_offset"
    resembles: ClassVar[tuple[str, ...]] = ("force_offset",)
    equation: ClassVar[str] = "q + q_0"
    source: ClassVar[str] = _AMPLIFIER
    needs_channel: ClassVar[str | None] = "cart_position"

    offset: Scalar = parameter(
        symbol="q_0", unit="m", meaning="LVDT reading at the spring's rest", null=0.0,
        plausible=lambda s: 0.03 * s.position,
    )  # fmt: skip

    def read(self, outputs: Outputs, own: States) -> Outputs:
        return outputs._replace(cart_position=outputs.cart_position + self.offset)


class LvdtNonlinearity(Sensor):
    """An LVDT scale that changes towards the ends of the travel."""

    id: ClassVar[str] = "lvdt_nonlinearity"
    equation: ClassVar[str] = "q + c q^3"
    source: ClassVar[str] = "Doebelin, Measurement Systems (2004), section 4.3"
    needs_channel: ClassVar[str | None] = "cart_position"

    cubic: Scalar = parameter(
        symbol="c", unit="1/m^2", meaning="cubic error of the LVDT", null=0.0,
        plausible=lambda s: 0.01 / s.position**2,
    )  # fmt: skip

    def read(self, outputs: Outputs, own: States) -> Outputs:
        q = outputs.cart_position
        return outputs._replace(cart_position=q + self.cubic * q**3)


class LvdtLag(_LatePosition):
    """A first-order lag of the LVDT's demodulator behind the cart's position."""

    id: ClassVar[str] = "lvdt_lag"
    equation: ClassVar[str] = "tau y' = q - y"
    source: ClassVar[str] = _FIRST_ORDER
    needs_channel: ClassVar[str | None] = "cart_position"
    states: ClassVar[dict[str, str]] = {"ahead": "m"}
    place: ClassVar[str] = "cart_position"
    speed: ClassVar[str] = "cart_velocity"

    time_constant: Scalar = _late("time constant of the LVDT", 2.0)

    def lag(self) -> Any:
        return self.time_constant


class ChannelDelay(_LatePosition):
    """A cart position that is sampled later than the arm's channels, as behind a multiplexer.

    The delay is Pade's approximation of first order, whose error is (w tau)^3 / 12 at the frequency w: under 1e-4 for
    the cart's oscillation and ten milliseconds. A delay of all channels alike is an `input_delay`.
    """

    id: ClassVar[str] = "channel_delay"
    equation: ClassVar[str] = "q(t - tau)"
    source: ClassVar[str] = _PADE
    needs_channel: ClassVar[str | None] = "cart_position"
    states: ClassVar[dict[str, str]] = {"ahead": "m"}
    place: ClassVar[str] = "cart_position"
    speed: ClassVar[str] = "cart_velocity"

    delay: Scalar = _late("delay of the cart's position", 1.0)

    def lag(self) -> Any:
        return 0.5 * self.delay

    def read(self, outputs: Outputs, own: States) -> Outputs:
        return outputs._replace(cart_position=outputs.cart_position + 2.0 * own[0])


class EncoderGain(Sensor):
    """A wrong scale of the encoder, as with a belt between encoder and arm."""

    id: ClassVar[str] = "encoder_gain"
    equation: ClassVar[str] = "(1 + g) theta"
    source: ClassVar[str] = _AMPLIFIER
    needs_channel: ClassVar[str | None] = "arm_angle"

    error: Scalar = _gain("encoder's scale")

    def read(self, outputs: Outputs, own: States) -> Outputs:
        return outputs._replace(arm_angle=outputs.arm_angle * (1.0 + self.error))


class EncoderOffset(Sensor):
    """An encoder whose zero is not where the arm points across the travel; it shows in the phase of the arm's pull."""

    id: ClassVar[str] = "encoder_offset"
    equation: ClassVar[str] = "theta + theta_0"
    source: ClassVar[str] = "mounting of an incremental encoder"
    needs_channel: ClassVar[str | None] = "arm_angle"

    offset: Scalar = parameter(
        symbol="theta_0", unit="rad", meaning="encoder reading at theta = 0", null=0.0, plausible=0.03
    )

    def read(self, outputs: Outputs, own: States) -> Outputs:
        return outputs._replace(arm_angle=outputs.arm_angle + self.offset)


class EncoderLag(_LatePosition):
    """An encoder counter that is read late, or filtered, with a first-order lag."""

    id: ClassVar[str] = "encoder_lag"
    equation: ClassVar[str] = "tau y' = theta - y"
    source: ClassVar[str] = _FIRST_ORDER
    needs_channel: ClassVar[str | None] = "arm_angle"
    states: ClassVar[dict[str, str]] = {"ahead": "rad"}
    place: ClassVar[str] = "arm_angle"
    speed: ClassVar[str] = "arm_velocity"

    time_constant: Scalar = _late("time constant of the encoder", 2.0)

    def lag(self) -> Any:
        return self.time_constant
