"""What may stand between the recorded current and the current that makes torque."""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from rtac_jax._parameter import Scalar, parameter
from rtac_jax.effects._interface import Actuator, Motion, States


class CurrentLag(Actuator):
    """The current drive follows its command with a first-order lag; the current starts at its command."""

    id: ClassVar[str] = "current_lag"
    equation: ClassVar[str] = "tau i' = i_command - i"
    source: ClassVar[str] = "Leonhard, Control of Electrical Drives (2001), section 7.1"
    states: ClassVar[dict[str, str]] = {"current": "A"}

    time_constant: Scalar = parameter(
        symbol="tau", unit="s", bounds=(0.0, np.inf), meaning="time constant of the current drive", null=0.0,
        plausible=lambda s: 2.0 * s.sample_time,
    )  # fmt: skip

    def current(self, current: Any, own: States) -> Any:
        return jnp.where(self.time_constant > 0, own[0], current)

    def start(self, motion: Motion) -> States:
        return (motion.current,)

    def rate(self, motion: Motion, own: States) -> States:
        acts = self.time_constant > 0
        return (jnp.where(acts, (motion.current - own[0]) / jnp.where(acts, self.time_constant, 1.0), 0.0),)


class DeadZone(Actuator):
    """No torque until the current exceeds a threshold, and the excess beyond it."""

    id: ClassVar[str] = "dead_zone"
    equation: ClassVar[str] = "i - clip(i, -i_0, i_0)"
    source: ClassVar[str] = (
        "Tao and Kokotovic, Adaptive Control of Systems with Actuator and Sensor Nonlinearities (1996)"
    )

    threshold: Scalar = parameter(
        symbol="i_0", unit="A", bounds=(0.0, np.inf), meaning="current without torque", null=0.0,
        plausible=lambda s: 0.05 * s.current,
    )  # fmt: skip

    def current(self, current: Any, own: States) -> Any:
        return current - jnp.clip(current, -self.threshold, self.threshold)


class CurrentOffset(Actuator):
    """The drive adds a constant to its command."""

    id: ClassVar[str] = "current_offset"
    equation: ClassVar[str] = "i + i_offset"
    source: ClassVar[str] = "offset of an analogue current loop"

    offset: Scalar = parameter(
        symbol="i_offset", unit="A", meaning="constant added to the current", null=0.0,
        plausible=lambda s: 0.03 * s.current,
    )  # fmt: skip

    def current(self, current: Any, own: States) -> Any:
        return current + self.offset
