"""The plan of an experiment to be carried out."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

HOLDS = ("zoh", "foh", "bl")
"""What an input may do between its samples."""


@dataclass(frozen=True, eq=False)
class Plan:
    """The plan of one experiment: the inputs, the start, and how it is sampled.

    There are N = round(duration / sample_time) samples, at t = n sample_time. Between samples the inputs are held
    ("zoh"), straight ("foh") or as smooth as the samples allow ("bl"); the recording says which, and says it wrongly
    where `played` differs. A plan of kind "rest" moves nothing: only sensor noise is recorded.

    Raises:
        ValueError: a field does not fit the others; the message names it.
    """

    name: str
    kind: Literal["free", "forced", "rest"] = "free"
    duration: float = 10.0
    """[s]."""
    sample_time: float = 0.005
    """[s]."""
    current: np.ndarray | None = None
    """(N,) commanded motor current [A]; None is no current."""
    disturbance_force: np.ndarray | None = None
    """(N,) force F on the cart [N]; None is no force."""
    initial_position: float = 0.0
    """[m]."""
    initial_velocity: float = 0.0
    """[m/s]."""
    initial_angle: float = 0.0
    """[rad]."""
    initial_arm_velocity: float = 0.0
    """[rad/s]."""
    arm: Literal["free", "locked"] = "free"
    cart: Literal["free", "clamped"] = "free"
    repeat_of: str | None = None
    """Name of the plan whose inputs and start this one repeats."""
    intersample: Literal["zoh", "foh", "bl"] = "zoh"
    """What the recording says of the inputs between samples."""
    played: Literal["zoh", "foh", "bl"] | None = None
    """What they really do; None is what the recording says."""

    def __post_init__(self) -> None:
        if self.kind not in ("free", "forced", "rest"):
            raise ValueError(f"Plan.kind is {self.kind!r}; use 'free', 'forced' or 'rest'.")
        if self.arm not in ("free", "locked"):
            raise ValueError(f"Plan.arm is {self.arm!r}; use 'free' or 'locked'.")
        if self.cart not in ("free", "clamped"):
            raise ValueError(f"Plan.cart is {self.cart!r}; use 'free' or 'clamped'.")
        if self.intersample not in HOLDS or self.hold not in HOLDS:
            raise ValueError(f"Plan.intersample and Plan.played are one of {', '.join(HOLDS)}.")
        if not (self.sample_time > 0 and self.samples >= 2):
            raise ValueError("Plan.sample_time must be positive and Plan.duration at least two samples long.")
        for name in ("current", "disturbance_force"):
            value = getattr(self, name)
            if value is not None and np.shape(value) != (self.samples,):
                raise ValueError(
                    f"Plan.{name} has shape {np.shape(value)}; {self.duration} s at {self.sample_time} s need"
                    f" ({self.samples},)."
                )
        if self.arm == "locked" and self.initial_arm_velocity != 0:
            raise ValueError("Plan.initial_arm_velocity must be zero when the arm is locked.")
        if self.cart == "clamped" and self.initial_velocity != 0:
            raise ValueError("Plan.initial_velocity must be zero when the cart is clamped.")

    @property
    def hold(self) -> str:
        """Return the true behaviour of the inputs between samples."""
        return self.played or self.intersample

    @property
    def samples(self) -> int:
        """Number of samples N."""
        return round(self.duration / self.sample_time)
