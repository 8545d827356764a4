"""Actuator effects: what may stand between the recorded current and the current that makes torque."""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from rtac_jax._numbers import Number
from rtac_jax._rigid_body import RigidBody
from rtac_jax.effects._interface import Actuator, Motion, States
from rtac_jax.effects._lag import averaged, behind
from rtac_jax.parameters import Scalar, parameter

_TAO = "Tao and Kokotovic, Adaptive Control of Systems with Actuator and Sensor Nonlinearities (1996)"


class Saturation(Actuator):
    """A drive that delivers no more than a largest current; its reciprocal is the parameter, so that 0 means no limit."""

    id: ClassVar[str] = "saturation"
    equation: ClassVar[str] = "clip(i, -1/g, 1/g)"
    source: ClassVar[str] = _TAO

    inverse_limit: Scalar = parameter(
        symbol="g = 1/i_max", unit="1/A", bounds=(0.0, np.inf), meaning="reciprocal of the largest current", null=0.0,
        plausible=lambda s: 0.8 / s.current,
    )  # fmt: skip

    def current(self, current: Number, own: States) -> Any:
        return current / jnp.maximum(1.0, self.inverse_limit * jnp.abs(current))


class CurrentLag(Actuator):
    """A first-order lag between the drive's command and its current; in equilibrium the current is its command.

    The command is taken as straight over an integration step, for which the lag is exact, be it as short as it likes.
    """

    id: ClassVar[str] = "current_lag"
    equation: ClassVar[str] = "tau i' = i_command - i"
    resembles: ClassVar[tuple[str, ...]] = ("input_delay",)
    source: ClassVar[str] = "Leonhard, Control of Electrical Drives (2001), section 7.1"
    states: ClassVar[dict[str, str]] = {"current": "A"}
    free_start: ClassVar[bool] = True
    closed: ClassVar[bool] = True

    time_constant: Scalar = parameter(
        symbol="tau", unit="s", bounds=(0.0, np.inf), meaning="time constant of the current drive", null=0.0,
        plausible=lambda s: 2.0 * s.sample_time,
    )  # fmt: skip

    def current(self, current: Number, own: States) -> Any:
        return jnp.where(self.time_constant > 0, own[0], current)

    def remark(self, body: RigidBody) -> str:
        del body
        return "Sensors that all lag by as much are nearly the same as current_lag."

    def start(self, motion: Motion) -> States:
        return (motion.current,)

    def rate(self, motion: Motion, own: States) -> States:
        acts = self.time_constant > 0
        return (jnp.where(acts, (motion.current - own[0]) / jnp.where(acts, self.time_constant, 1.0), 0.0),)

    def follow(self, motion: Motion, own: States) -> States:
        first = motion.began.current
        return (motion.last + behind(own[0] - first, self.time_constant / motion.step, motion.last - first),)

    def during(self, motion: Motion, own: States) -> States:
        first, ratio = motion.began.current, self.time_constant / motion.step
        return (motion.current + averaged(own[0] - first, ratio, motion.last - first, motion.elapsed),)


class CurrentOffset(Actuator):
    """A constant that the drive adds to its command."""

    id: ClassVar[str] = "current_offset"
    equation: ClassVar[str] = "i + i_offset"
    source: ClassVar[str] = "offset of an analogue current loop"

    offset: Scalar = parameter(
        symbol="i_offset", unit="A", meaning="constant added to the current", null=0.0,
        plausible=lambda s: 0.03 * s.current,
    )  # fmt: skip

    def current(self, current: Number, own: States) -> Any:
        return current + self.offset

    def remark(self, body: RigidBody) -> str:
        torque = float(np.max(np.abs(self.offset * body.torque_constant)))
        return (
            f"While the arm moves, dry friction that is {torque:.3g} N m more one way and as much less the other is the same as "
            "current_offset."
        )


class DeadZone(Actuator):
    """A current without torque up to a threshold; beyond it only the excess makes torque."""

    id: ClassVar[str] = "dead_zone"
    equation: ClassVar[str] = "i - clip(i, -i_0, i_0)"
    source: ClassVar[str] = _TAO

    threshold: Scalar = parameter(
        symbol="i_0", unit="A", bounds=(0.0, np.inf), meaning="current without torque", null=0.0,
        plausible=lambda s: 0.05 * s.current,
    )  # fmt: skip

    def current(self, current: Number, own: States) -> Any:
        return current - jnp.clip(current, -self.threshold, self.threshold)


class TorqueDroop(Actuator):
    """A torque per ampere that falls as the current saturates the iron; i is the current that would make the same torque."""

    id: ClassVar[str] = "torque_droop"
    equation: ClassVar[str] = "i / (1 + c |i|)"
    source: ClassVar[str] = "Froehlich's magnetisation curve; Krause, Analysis of Electric Machinery (2013), chapter 1"

    droop: Scalar = parameter(
        symbol="c", unit="1/A", bounds=(0.0, np.inf), meaning="relative fall of the torque constant per ampere",
        null=0.0, plausible=lambda s: 0.1 / s.current,
    )  # fmt: skip

    def current(self, current: Number, own: States) -> Any:
        return current / (1.0 + self.droop * jnp.abs(current))
