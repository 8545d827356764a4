"""Recordings as arrays, and the functions that load and cut them."""

import dataclasses
import hashlib
import itertools
from collections.abc import Collection, Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from rtac_jax import Excitation
from rtac_jax.excitation import BEYOND, Real
from rtac_jax.measurement import OUTPUTS, Experiment, Recording
from rtac_jax.programs.arrays import to_jax
from rtac_jax.time_loop import room_for

CHANNELS = tuple(OUTPUTS)
_LONG = 8192  # samples that are simulated in one piece
_PIECE = 512
_SEVERAL = 2 * _PIECE  # beside others that are cut
Values = Float[np.ndarray, " sample"]
Outputs3 = Float[Real, "sample output experiment"]


class Data(eqx.Module):
    """The experiments as arrays of one shape, with room for more samples than the longest has.

    Attributes:
        excitation: the inputs.
        values: outputs in the order of `CHANNELS`; zero where there is none.
        present: 1 where an output was measured, else 0.
        trusted: 0 where a filter follows the outputs but its likelihood and its innovations do not count, else 1.
        length: samples of the longest experiment, or of the part of all experiments that is run through.
    """

    excitation: Excitation
    values: Outputs3
    present: Outputs3
    trusted: Float[Real, "sample experiment"]
    length: Int[Real, ""]

    @classmethod
    def of(cls, experiments: Sequence[Experiment]) -> "Data":
        """Stack experiments of any lengths and channels."""
        return jax.tree.map(to_jax, cls.in_numpy(experiments))

    @classmethod
    def in_numpy(cls, experiments: Sequence[Experiment]) -> "Data":
        """Stack experiments as `of` does, in arrays of NumPy, for what is put side by side before it is computed with."""
        samples = max(e.samples for e in experiments)
        values = np.full((room_for(samples + BEYOND), len(CHANNELS), len(experiments)), np.nan)
        for column, experiment in enumerate(experiments):
            for row, channel in enumerate(CHANNELS):
                if channel in experiment.outputs:
                    values[: experiment.samples, row, column] = experiment.outputs[channel].values
        present = np.isfinite(values)
        return cls(
            Excitation.in_numpy(experiments, room=len(values)),
            np.where(present, values, 0.0),
            present.astype(float),
            np.ones((values.shape[0], values.shape[2])),
            np.asarray(samples),
        )

    def beginning(self, samples: int) -> "Data":
        """Return the first so many samples of every experiment, in arrays of the same shape, for which nothing compiles anew."""
        within = jnp.arange(self.room)[:, None, None] < samples
        return dataclasses.replace(self, present=self.present * within, length=to_jax(min(samples, self.samples)))

    @property
    def counted(self) -> Outputs3:
        """Return 1 where an output was measured and counts, else 0."""
        return self.present * self.trusted[:, None]

    @property
    def room(self) -> int:
        """Return the length of the arrays."""
        return self.values.shape[0]

    @property
    def samples(self) -> int:
        """Return the length of the longest experiment; not within compiled code."""
        return int(self.length)

    @property
    def experiments(self) -> int:
        """Return the number of experiments."""
        return self.values.shape[2]


def squares_of_motion(
    data: Data,
) -> tuple[Float[np.ndarray, "output experiment"], Float[np.ndarray, "output experiment"]]:
    """Return the sum of squares of each channel about its mean in an experiment, and the number of its samples."""
    values, present = np.asarray(data.values), np.asarray(data.present)
    count = present.sum(axis=0)
    mean = (values * present).sum(axis=0) / np.maximum(count, 1.0)
    return ((values - mean) ** 2 * present).sum(axis=0), count


def motion_of(data: Data) -> Float[np.ndarray, " output"]:
    """Return the rms of each channel about its mean in each experiment; zero where there is none."""
    squares, count = squares_of_motion(data)
    return np.sqrt(squares.sum(axis=1) / np.maximum(count.sum(axis=1), 1.0))


def in_channels(levels: Mapping[str, float]) -> Float[np.ndarray, " output"]:
    """Return what is known of channels, in their order; 1 where nothing is known of one."""
    return np.array([levels.get(channel, 1.0) for channel in CHANNELS])


def mark_of(experiment: Experiment) -> str:
    """Return a digest of the measurements; another recording may hold an experiment of the same name."""
    digest = hashlib.blake2b(digest_size=16)
    for channel in sorted(experiment.outputs):
        digest.update(channel.encode() + np.ascontiguousarray(experiment.outputs[channel].values).tobytes())
    return digest.hexdigest()


def moving(recording: Recording) -> list[Experiment]:
    """Return the experiments that are not rest records.

    Raises:
        ValueError: there is none.
    """
    found = [e for e in recording.experiments if e.kind != "rest"]
    if not found:
        raise ValueError("the recording holds rest records only; add an experiment in which the rig moves.")
    return found


def fitted_part(recording: Recording, names: Collection[str]) -> Recording:
    """Return the recording with the experiments that were fitted, and its rest records.

    Args:
        recording: that may hold more.
        names: of the fitted experiments or of their `pieces`.

    Raises:
        ValueError: it holds none of them.
    """
    kept = [e for e in recording.experiments if e.kind == "rest" or is_among(e, names)]
    if all(e.kind == "rest" for e in kept):
        raise ValueError(
            f"the fit used {', '.join(names)}, and this recording holds none of these; give the recording that was fitted."
        )
    if len(kept) == len(recording.experiments):
        return recording
    return dataclasses.replace(recording, experiments=tuple(kept))


def is_among(e: Experiment, names: Collection[str]) -> bool:
    """Return whether an experiment has one of some names, whole or cut."""
    return any(piece.name in names for longest in (_LONG, _SEVERAL) for piece in _cut(e, longest))


def pieces(experiments: Sequence[Experiment]) -> list[Experiment]:
    """Cut long experiments into pieces that are simulated side by side, each with a start of its own.

    Only where every piece shows where it starts: with the arm locked or its angle measured. Where one is cut, so are others of
    several pieces, as all are simulated for as long as the longest. What comes before the first sample that a sensor measured is
    cut off, too.
    """
    longest = _longest(experiments)
    return [piece for e in experiments for piece in _cut(e, longest)]


def _longest(experiments: Sequence[Experiment]) -> int:
    """Return the samples up to which none of several experiments is cut."""
    long = any(_shows_its_start(e) and e.samples - first_sample(e) > _LONG for e in experiments)
    return _SEVERAL if long else _LONG


def _cut(e: Experiment, longest: int) -> list[Experiment]:
    begin = first_sample(e)
    samples = e.samples - begin
    if samples <= longest or not _shows_its_start(e):
        return [e.cut(begin, e.samples) if begin else e]
    showing = ["arm_angle"] if e.arm == "free" else list(e.outputs)
    seen = np.any([np.isfinite(e.outputs[channel].values) for channel in showing], axis=0)
    edges = [begin]
    for edge in map(int, np.linspace(begin, e.samples, round(samples / _PIECE) + 1)[1:]):
        if seen[edges[-1] : edge].any():  # a piece that does not show where it starts goes on
            edges.append(edge)
    edges[max(len(edges) - 1, 1) :] = [e.samples]
    return [_with_what_was_measured(e, a, b) for a, b in itertools.pairwise(edges)]


def _with_what_was_measured(e: Experiment, begin: int, end: int) -> Experiment:
    """Return a piece of an experiment, without the sensors that measured nothing in it."""
    measured = {c: s for c, s in e.outputs.items() if np.isfinite(s.values[begin:end]).any()}
    whole = e if len(measured) == len(e.outputs) else dataclasses.replace(e, outputs=measured)
    return whole.cut(begin, end, f"{e.name}[{begin}:{end}]")


def first_sample(experiment: Experiment) -> int:
    """Return the first sample at which an output was measured; 0 where the outputs then would not show where the rig is."""
    if not _shows_its_start(experiment):
        return 0
    return int(min(np.argmax(np.isfinite(signal.values)) for signal in experiment.outputs.values()))


def _shows_its_start(experiment: Experiment) -> bool:
    return experiment.arm != "free" or "arm_angle" in experiment.outputs


def origins(experiments: Sequence[Experiment]) -> dict[str, str]:
    """Return by the name of each of their `pieces` the name of the experiment that it is cut from, in the order of time."""
    longest = _longest(experiments)
    return {piece.name: e.name for e in experiments for piece in _cut(e, longest)}
