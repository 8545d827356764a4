"""The plan of an experiment to be carried out."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from ._experiment import Experiment

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
        """Return the number of samples N."""
        return round(self.duration / self.sample_time)

    @property
    def start(self) -> tuple[float, float, float, float]:
        """Cart position [m], cart velocity [m/s], arm angle [rad] and arm velocity [rad/s] at the start."""
        return self.initial_position, self.initial_velocity, self.initial_angle, self.initial_arm_velocity

    @property
    def held(self) -> frozenset[str]:
        """Outputs that cannot change, because cart or arm is held."""
        arm = ("arm_velocity", "arm_angle") if self.arm == "locked" else ()
        return frozenset(arm + (("cart_position",) if self.cart == "clamped" else ()))

    def experiment(self, outputs: Mapping[str, Float[np.ndarray, " sample"]], **more: Any) -> Experiment:
        """Return what is recorded when the plan is carried out and these are its outputs, SI units.

        Args:
            outputs: measured, by channel.
            more: of `Experiment.of`, as `noise_std`.
        """
        return Experiment.of(
            self.name, kind=self.kind, sample_time=self.sample_time, current=self.current,
            disturbance_force=self.disturbance_force, intersample=self.intersample, initial_arm_angle=self.initial_angle,
            arm=self.arm, cart=self.cart, **outputs, **more,
        )  # fmt: skip

    def to_simulate(self) -> Experiment:
        """Return the plan as an experiment of which only the inputs are looked at; its outputs are ramps."""
        # An experiment in which nothing shows would be refused.
        ramp = np.arange(self.samples, dtype=float)
        return self.experiment({c: ramp for c in ("cart_position", "arm_velocity") if c not in self.held})
