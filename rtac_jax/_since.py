"""The beginning of the integration step that is being taken, as far as effects may know it."""

from typing import Any, NamedTuple

from rtac_jax.effects import Actuator, Motion
from rtac_jax.effects._interface import States


class Since(NamedTuple):
    """The beginning of an integration step.

    Attributes:
        motion: there.
        step: length of the step [s].
        last: the current at its end [A].
        elapsed: fraction of the step that has gone by.
    """

    motion: Motion
    step: Any
    last: Any
    elapsed: Any

    def seen_from(self, motion: Motion) -> Motion:
        """Return a motion within the step that knows of its beginning."""
        return motion._replace(began=self.motion, elapsed=self.elapsed, step=self.step, last=self.last)


def through(effect: Actuator, motion: Motion, before: States, now: States) -> Motion:
    """Return the motion with the currents after an actuator stage, now and at both ends of the step."""
    current = effect.current(motion.current, now)
    if motion.began is None:
        return motion._replace(current=current)
    began = motion.began._replace(current=effect.current(motion.began.current, before))
    return motion._replace(current=current, began=began, last=effect.current(motion.last, now))
