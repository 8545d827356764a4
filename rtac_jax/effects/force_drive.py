"""Effects of the drive that makes the recorded force on the cart, as a motor with a belt or a screw does."""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from rtac_jax._numbers import Number
from rtac_jax._rigid_body import RigidBody
from rtac_jax.effects._interface import Force, Input, Motion, Pieces, States
from rtac_jax.effects._lag import averaged, behind
from rtac_jax.effects.between_samples import delayed, straightened
from rtac_jax.parameters import Scalar, parameter

_TAO = "Tao and Kokotovic, Adaptive Control of Systems with Actuator and Sensor Nonlinearities (1996)"


class ForceSaturation(Force):
    """A drive that delivers no more than a largest force; its reciprocal is the parameter, so that 0 means no limit."""

    id: ClassVar[str] = "force_saturation"
    equation: ClassVar[str] = "clip(F, -1/g, 1/g)"
    source: ClassVar[str] = _TAO
    port: ClassVar[str] = "force drive"
    nature: ClassVar[str] = "source"

    inverse_limit: Scalar = parameter(
        symbol="g = 1/F_max", unit="1/N", bounds=(0.0, np.inf), meaning="reciprocal of the largest force", null=0.0,
        plausible=lambda s: 0.8 / s.applied_force,
    )  # fmt: skip

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        del own
        delivered = motion.force / jnp.maximum(1.0, self.inverse_limit * jnp.abs(motion.force))
        return delivered - motion.force, 0.0


class ForceDeadZone(Force):
    """A recorded force of which nothing reaches the cart up to a threshold; beyond it the excess does."""

    id: ClassVar[str] = "force_dead_zone"
    equation: ClassVar[str] = "F - clip(F, -F_0, F_0)"
    source: ClassVar[str] = _TAO
    port: ClassVar[str] = "force drive"
    nature: ClassVar[str] = "source"

    threshold: Scalar = parameter(
        symbol="F_0", unit="N", bounds=(0.0, np.inf), meaning="force that does not reach the cart", null=0.0,
        plausible=lambda s: 0.05 * s.applied_force,
    )  # fmt: skip

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        del own
        return -jnp.clip(motion.force, -self.threshold, self.threshold), 0.0


class ForceDroop(Force):
    """A force that falls short of the recorded one the more it is, as of an amplifier or a motor near what it can do."""

    id: ClassVar[str] = "force_droop"
    equation: ClassVar[str] = "F / (1 + c |F|)"
    source: ClassVar[str] = "as torque_droop: Krause, Analysis of Electric Machinery (2013), chapter 1"
    port: ClassVar[str] = "force drive"
    nature: ClassVar[str] = "source"

    droop: Scalar = parameter(
        symbol="c", unit="1/N", bounds=(0.0, np.inf), meaning="relative fall of the force per newton that is recorded",
        null=0.0, plausible=lambda s: 0.1 / s.applied_force,
    )  # fmt: skip

    def force(self, motion: Motion, own: States) -> tuple[Any, Any]:
        del own
        lost = self.droop * jnp.abs(motion.force)
        return -motion.force * lost / (1.0 + lost), 0.0


class ForceDelay(Input):
    """A transport delay of the force behind its command; see `InputDelay`, which is the same of the current."""

    id: ClassVar[str] = "force_delay"
    equation: ClassVar[str] = "F(t) = F_command(t - tau)"
    resembles: ClassVar[tuple[str, ...]] = ("force_lag",)
    source: ClassVar[str] = "Astrom and Wittenmark, Computer-Controlled Systems (1997), section 2.3"
    port: ClassVar[str] = "force drive"

    delay: Scalar = parameter(
        symbol="tau", unit="s", bounds=(0.0, np.inf), meaning="transport delay of the force", null=0.0,
        plausible=lambda s: 1.5 * s.sample_time,
    )  # fmt: skip

    def remark(self, body: RigidBody) -> str:
        del body
        return "Sensors that are all late by as much are the same as force_delay."

    def transform(self, coefficients: Pieces, channel: str, sample_time: Number) -> Pieces:
        return delayed(coefficients, self.delay, sample_time) if channel == "force" else coefficients


class ForceLag(Input):
    """A first-order lag of the force behind its command, which is in equilibrium where a record begins.

    The command is taken as the straight line over an interval that has its mean and its first moment, for which the lag is exact;
    what else of it is curved there goes along. So is the force in an interval.
    """

    id: ClassVar[str] = "force_lag"
    equation: ClassVar[str] = "tau F' = F_command - F"
    resembles: ClassVar[tuple[str, ...]] = ("force_delay",)
    source: ClassVar[str] = "Leonhard, Control of Electrical Drives (2001), section 7.1"
    port: ClassVar[str] = "force drive"

    time_constant: Scalar = parameter(
        symbol="tau", unit="s", bounds=(0.0, np.inf), meaning="time constant of the force's drive", null=0.0,
        plausible=lambda s: 2.0 * s.sample_time,
    )  # fmt: skip

    def remark(self, body: RigidBody) -> str:
        del body
        return "Sensors that all lag by as much are nearly the same as force_lag."

    def transform(self, coefficients: Pieces, channel: str, sample_time: Number) -> Pieces:
        if channel != "force":
            return coefficients
        ratio, line = self.time_constant / sample_time, straightened(coefficients)
        first, last = line[:, 0], line[:, 0] + line[:, 1]

        def onward(force: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
            begin, end = row
            return end + behind(force - begin, ratio, end - begin), force - begin

        _, by = jax.lax.scan(onward, coefficients[0, 0], (first, last))
        early, late = (averaged(by, ratio, last - first, elapsed) for elapsed in (0.0, 1.0))
        wide = jnp.pad(coefficients, ((0, 0), (0, max(2 - coefficients.shape[1], 0)), (0, 0)))
        return wide.at[:, 0].add(early).at[:, 1].add(late - early)
