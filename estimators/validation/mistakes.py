"""Usual mistakes of recordings, each with what undoes it: units, signs, swapped channels, clocks and constants."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from rtac_jax.measurement import INPUTS, OUTPUTS, Experiment, RecordingError, Signal

Undo = Callable[[Experiment], Experiment | None]
Rig = Mapping[str, float]

# Numbers of samples by which a channel may be late. Fewer are a lag of a sensor or a drive, ten milliseconds at the usual rates,
# which is an effect of the catalogue; more are an eighth of the cart's period, and look like another sign or another experiment.
DELAYS = (3, 4, 5, 6, 7, 8, 9, 10, 12, 14, 16)
_SHARP = 2  # samples, the distance of those that are tried of the longer ones
COARSE = (4, 8, 13)  # those that are tried first: one of them is within three samples of each of the others


@dataclasses.dataclass(frozen=True)
class Mistake:
    """A mistake, and how a recording would be without it.

    Attributes:
        id: names it.
        seen: how the recording reads if it was made, after "its" or "every": "arm_velocity fits with the sign swapped".
        mend: what to do.
        undo: returns an experiment without the mistake; None where the experiment cannot have it.
        undo_rig: returns the constants of the rig without the mistake; None where it concerns experiments.
        single: whether one experiment alone may have it.
        every: whether all experiments may have it and the equations of motion show it.
        scale: what a channel, by name, is multiplied by to undo it; None where it is no unit.
        channel, samples: that comes late by so many of them; empty and zero where it is no delay.
    """

    id: str
    seen: str
    mend: str
    undo: Undo = lambda experiment: experiment
    undo_rig: Callable[[Rig], Rig | None] | None = None
    single: bool = True
    every: bool = True
    scale: tuple[str, float] | None = None
    channel: str = ""
    samples: int = 0


def is_blurred(alike: Sequence[Mistake]) -> bool:
    """Return whether a delay explains as well as others of its channel by several samples: a clock is off by one number of them."""
    first = alike[0]
    same = [m for m in alike[1:] if m.samples and first.samples and m.channel == first.channel]
    return any(abs(m.samples - first.samples) > _SHARP for m in same)


def usual_mistakes() -> list[Mistake]:
    """Return the mistakes that are looked for; of two that look alike the more particular first, then the commoner."""
    return [*_angles(), *_signs(), *_units(), *_clocks(), *_swaps(), *_half_turns(), *_constants()]


def delays(channel: str, counts: tuple[int, ...]) -> Iterator[Mistake]:
    """Yield one mistake for each number of samples that a channel may come late or early."""
    for samples in (sign * count for count in counts for sign in (1, -1)):
        when = "late" if samples > 0 else "early"
        yield Mistake(
            f"{channel} {samples:+d} samples",
            f"{channel} fits when it is taken to come {abs(samples)} samples {when}",
            f"shift {channel} by {-samples} samples against the other channels, or synchronise the loggers; where they are "
            "synchronous something lags, which est.diagnose names",
            lambda e, samples=samples: _with(e, channel, lambda x: _shifted(x, -samples)),
            channel=channel,
            samples=samples,
        )


def _signs() -> Iterator[Mistake]:
    for channel in ("current", "arm_velocity", "cart_position", "disturbance_force"):
        yield Mistake(
            f"sign of {channel}",
            f"{channel} fits with the sign swapped",
            f"multiply {channel} by -1, or swap the two wires",
            lambda e, channel=channel: _with(e, channel, np.negative),
        )
    # An encoder that counts backwards is integrated from where the arm starts.
    yield Mistake(
        "sign of arm_angle",
        "arm_angle fits with the sign swapped",
        "multiply arm_angle by -1",
        lambda e: _with(e, "arm_angle", np.negative),
    )


def _units() -> Iterator[Mistake]:
    for channel, unit, factor in (
        ("cart_position", "mm", 1e-3),
        ("cart_position", "cm", 1e-2),
        ("arm_velocity", "deg/s", np.pi / 180),
        ("arm_velocity", "rpm", np.pi / 30),
        ("arm_velocity", "revolutions per second", 2 * np.pi),
        ("arm_angle", "degrees", np.pi / 180),
        ("arm_angle", "revolutions", 2 * np.pi),
    ):
        yield Mistake(
            f"{channel} in {unit}",
            f"{channel} fits when it is taken to be in {unit}",
            f"multiply {channel} by {factor:.4g}, or give its unit on reading",
            lambda e, channel=channel, factor=factor: _with(e, channel, lambda x: factor * x),
            scale=(channel, factor),
        )
    for heading, factor in (("rpm", 30 / np.pi), ("deg/s", 180 / np.pi)):
        yield Mistake(
            f"arm_velocity no {heading}",
            f"arm_velocity fits when it is taken to have been in rad/s, and was read as {heading}",
            f"multiply arm_velocity by {factor:.4g}, or read it as rad/s",
            lambda e, factor=factor: _with(e, "arm_velocity", lambda x: factor * x),
            scale=("arm_velocity", factor),
        )
    for channel, unit in (("current", "mA"), ("disturbance_force", "mN")):
        # In all experiments alike it is a torque constant, or a mass, that is unusual but possible.
        yield Mistake(
            f"{channel} in {unit}",
            f"{channel} fits when it is taken to be in {unit}",
            f"multiply {channel} by 0.001, or give its unit on reading",
            lambda e, channel=channel: _with(e, channel, lambda x: 1e-3 * x),
            every=channel == "disturbance_force",
            scale=(channel, 1e-3),
        )


def _clocks() -> Iterator[Mistake]:
    for factor, what in (
        (0.5, "half of the sample_time that it has"),
        (2.0, "twice the sample_time that it has"),
        (1e-3, "a thousandth of the sample_time that it has"),
        (1e3, "a thousand times the sample_time that it has"),
    ):
        yield Mistake(
            f"sample_time times {1 / factor:g}",
            f"motion fits with {what}",
            f"multiply sample_time by {factor:g}, or give it in seconds",
            lambda e, factor=factor: dataclasses.replace(e, sample_time=factor * e.sample_time),
        )


def _swaps() -> Iterator[Mistake]:
    for one, other in (
        ("cart_position", "arm_velocity"),
        ("arm_velocity", "arm_angle"),
        ("cart_position", "arm_angle"),
    ):
        yield Mistake(
            f"{one} and {other} swapped",
            f"{one} and {other} fit when they are swapped",
            "swap the two columns",
            lambda e, one=one, other=other: _swapped(e, "outputs", one, other),
        )
    for channel in ("arm_velocity", "cart_position"):
        yield Mistake(
            f"current and {channel} swapped",
            f"current and {channel} fit when they are swapped",
            "swap the two columns",
            lambda e, channel=channel: _swapped_with_current(e, channel),
        )
    yield Mistake(
        "current recorded as disturbance_force",
        "disturbance_force fits when it is taken to be the current",
        "record it as current",
        lambda e: _swapped(e, "inputs", "disturbance_force", "current"),
    )
    yield Mistake(
        "disturbance_force recorded as current",
        "current fits when it is taken to be the disturbance_force",
        "record it as disturbance_force",
        lambda e: (
            _swapped(e, "inputs", "current", "disturbance_force") if "disturbance_force" not in e.inputs else None
        ),
    )


def _angles() -> Iterator[Mistake]:
    yield Mistake(
        "initial_arm_angle in degrees",
        "initial_arm_angle fits when it is taken to be in degrees",
        "multiply it by 0.01745",
        lambda e: _started(e, np.deg2rad),
    )


def _half_turns() -> Iterator[Mistake]:
    yield Mistake(
        "initial_arm_angle off by half a turn",
        "initial_arm_angle fits half a turn away",
        "add 3.1416 to it",
        lambda e: _started(e, lambda x: x + np.pi),
    )
    yield Mistake(
        "sign of initial_arm_angle",
        "initial_arm_angle fits with the sign swapped",
        "multiply it by -1",
        lambda e: _started(e, lambda x: -x),
    )


def _constants() -> Iterator[Mistake]:
    for name, what, factor in (
        ("total_mass", "total_mass is 1000 times too large, as if in g", 1e-3),
        ("arm_inertia", "arm_inertia is 1000 times too large, as if in g m^2", 1e-3),
        ("arm_inertia", "arm_inertia is 10 times too large", 0.1),
        ("arm_inertia", "arm_inertia is 10 times too small", 10.0),
        ("arm_inertia", "arm_inertia is 100 times too large", 1e-2),
        ("arm_inertia", "arm_inertia is 100 times too small", 1e2),
        ("arm_inertia", "arm_inertia is 10,000 times too large, as if in kg cm^2", 1e-4),
        ("arm_inertia", "arm_inertia is 10^6 times too large, as if in kg mm^2", 1e-6),
        ("arm_inertia", "arm_inertia is 10^7 times too large, as if in g cm^2", 1e-7),
        ("total_mass", "total_mass is 1000 times too small, as if in t", 1e3),
    ):

        def corrected(rig: Rig, name: str = name, factor: float = factor) -> Rig | None:
            return {**rig, name: factor * rig[name]} if {"total_mass", "arm_inertia"} <= set(rig) else None

        yield Mistake(
            f"{name} times {1 / factor:g}",
            f"motion fits when {what}; only the ratio of total_mass to arm_inertia shows, so it may be the other one",
            f"weigh again, and multiply {name} by {factor:g} in /rig",
            undo_rig=corrected,
            single=False,
        )


def _with(experiment: Experiment, channel: str, change: Callable[[np.ndarray], np.ndarray]) -> Experiment | None:
    """Return the experiment with one channel changed; None where it does not have it or may not be so."""
    group = "inputs" if channel in INPUTS else "outputs"
    signals = dict(getattr(experiment, group))
    if channel not in signals or not np.any(signals[channel].values):
        return None
    old = signals[channel]
    signals[channel] = Signal(change(np.asarray(old.values)), old.unit, old.intersample)
    return _replaced(experiment, group, signals)


def _swapped(experiment: Experiment, group: str, one: str, other: str) -> Experiment | None:
    """Return the experiment with two channels of a group exchanged; an input may be absent."""
    signals, units = dict(getattr(experiment, group)), INPUTS if group == "inputs" else OUTPUTS
    if one not in signals or (group == "outputs" and other not in signals):
        return None
    first, second = signals.pop(one), signals.pop(other, None)
    signals[other] = Signal(first.values, units[other], first.intersample)
    if second is not None:
        signals[one] = Signal(second.values, units[one], second.intersample)
    return _replaced(experiment, group, signals)


def _swapped_with_current(experiment: Experiment, channel: str) -> Experiment | None:
    """Return the experiment with the current and an output exchanged; None where one of them is not there."""
    inputs, outputs = dict(experiment.inputs), dict(experiment.outputs)
    if "current" not in inputs or channel not in outputs:
        return None
    current, measured = np.asarray(inputs["current"].values), np.asarray(outputs[channel].values)
    inputs["current"] = Signal(measured, INPUTS["current"], inputs["current"].intersample)
    outputs[channel] = Signal(current, OUTPUTS[channel], outputs[channel].intersample)
    changed = _replaced(experiment, "inputs", inputs)
    return None if changed is None else _replaced(changed, "outputs", outputs)


def _started(experiment: Experiment, change: Callable[[float], float]) -> Experiment | None:
    """Return the experiment with another angle at the start; None where the angle is measured and does not need it."""
    angle = experiment.initial_arm_angle
    if angle is None or "arm_angle" in experiment.outputs:
        return None
    return dataclasses.replace(experiment, initial_arm_angle=float(change(angle)))


def _replaced(experiment: Experiment, group: str, signals: Mapping[str, Signal]) -> Experiment | None:
    with contextlib.suppress(RecordingError):
        return dataclasses.replace(experiment, **{group: signals})
    return None


def _shifted(values: np.ndarray, samples: int) -> np.ndarray:
    """Return the signal later by so many samples; its first or last value fills the end."""
    place = np.clip(np.arange(len(values)) - samples, 0, len(values) - 1)
    return values[place]


def as_well(alike: Sequence[Mistake]) -> str:
    """Say which mistakes explain as much as another; nothing where none do."""
    return f" As well fits: {'; '.join(m.seen for m in alike[:2])}." if alike else ""
