"""The excitation of a set of experiments, as arrays for the time loop: padded to one length, one column each."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.interpolate import CubicSpline

from rtac_jax.measurement import Experiment, Signal
from rtac_jax.programs.arrays import to_jax

if TYPE_CHECKING:
    Real = Any
else:
    Real = Array | np.ndarray
"""Arrays of JAX within compiled code, of NumPy where they are put side by side."""

BEYOND = 12  # samples by which an input goes on after its last, for effects that look ahead


class Excitation(eqx.Module):
    """The inputs of several experiments between their samples, as polynomials in the fraction of the interval.

    Attributes:
        current: polynomial coefficients, rising powers [A]; None where no experiment has a current.
        force: the same of the disturbance force [N].
        sample_time: [s].
        arm_free, cart_free: 1 where it may move, 0 where it is held.
        samples: of each experiment; None where all last as long as the arrays.
    """

    current: Float[Real, "sample current_power experiment"] | None
    force: Float[Real, "sample force_power experiment"] | None
    sample_time: Float[Real, " experiment"]
    arm_free: Float[Real, " experiment"]
    cart_free: Float[Real, " experiment"]
    samples: Int[Real, " experiment"] | None = None

    @classmethod
    def of(cls, experiments: Sequence[Experiment], *, room: int | None = None) -> "Excitation":
        """Stack the inputs of experiments of any lengths, sample times and channels.

        Beyond its end an input goes on for a few samples as its mirror image, evenly in value and slope, and is zero then.

        Args:
            experiments: one column each.
            room: length of the arrays, by default that of the longest experiment.
        """
        return jax.tree.map(to_jax, cls.in_numpy(experiments, room=room))

    @classmethod
    def in_numpy(cls, experiments: Sequence[Experiment], *, room: int | None = None) -> "Excitation":
        """Stack the inputs as `of` does, in arrays of NumPy, for what is put side by side before it is computed with."""
        room = room or max(e.samples for e in experiments)
        return cls(
            current=_stack(experiments, "current", room),
            force=_stack(experiments, "disturbance_force", room),
            sample_time=np.array([e.sample_time for e in experiments]),
            arm_free=np.array([float(e.arm == "free") for e in experiments]),
            cart_free=np.array([float(e.cart == "free") for e in experiments]),
            samples=np.array([e.samples for e in experiments]),
        )

    def lasts(self, room: int) -> Bool[Array, "sample experiment"]:
        """Return True at the samples of each experiment and False beyond its end, where a state is held as it is.

        A state that ran on beside longer experiments could leave all bounds, and zero times that is not zero.

        Args:
            room: length of the arrays.
        """
        samples = jnp.full(self.sample_time.shape, room) if self.samples is None else self.samples
        return jnp.arange(room)[:, None] < samples

    def first_current(self) -> Float[Array, " experiment"]:
        """Return the current at the first sample [A]."""
        if self.current is None:
            return jnp.zeros_like(self.sample_time)
        return self.current[0, 0]


def _stack(experiments: Sequence[Experiment], channel: str, room: int) -> np.ndarray | None:
    signals = [e.inputs.get(channel) for e in experiments]
    if not any(signal is not None and np.any(signal.values) for signal in signals):
        return None
    parts = [None if signal is None else coefficients(signal) for signal in signals]
    powers = max(part.shape[1] for part in parts if part is not None)
    stacked = np.zeros((room, powers, len(experiments)))
    for column, part in enumerate(parts):
        if part is not None:
            stacked[: len(part), : part.shape[1], column] = part
            on = np.pad(part[:, 0], (0, BEYOND), mode="reflect", reflect_type="odd")[len(part) : room]
            stacked[len(part) : len(part) + len(on), 0, column] = on
    return stacked


def coefficients(signal: Signal) -> Float[np.ndarray, "sample power"]:
    """Return rising powers of the fraction of the interval that follows each sample; the last one holds its value."""
    values = signal.values
    if signal.intersample == "zoh":
        return values[:, None]
    if signal.intersample == "foh":
        return np.stack([values, np.append(np.diff(values), 0.0)], axis=1)
    # A natural choice for a band-limited signal that is sampled well above its band: the cubic spline through it.
    spline = CubicSpline(np.arange(len(values)), values).c[::-1].T
    last = np.zeros((1, 4))
    last[0, 0] = values[-1]
    return np.concatenate([spline, last])
