"""Candidate experiments that a rig could do next, kept by simulation within its travel, torque and speed."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rtac_jax import RTAC, Simulation, simulate
from rtac_jax.measurement import Experiment, Plan, filled, multisine

_MARGIN = 0.85  # fraction of travel and speed that the model may use: the rig departs from it
_ROUNDS = 8  # in which a current is lowered until the limits hold
_FEWER = 0.9
_ALIKE = 0.02  # of the largest current, up to which two currents are one experiment

_DISPLACEMENTS = (0.2, 0.5, 0.8)  # of the travel
_ANGLES = (0.0, 0.25 * np.pi, 0.5 * np.pi)
_SWINGS = (0.5, 1.5)  # rad, of the arm under a square wave or a chirp
_SQUARES = (0.5, 1.0, 1.6, 3.0, 6.0)  # Hz
_BANDS = ((0.3, 3.0), (1.0, 8.0), (3.0, 20.0))  # Hz
_LEAD = 0.1  # s without current at the beginning
_SPEEDS = (4.0, 12.0, 30.0)  # rad/s, at which friction balances a steady current


@dataclasses.dataclass(frozen=True)
class Limits:
    """The limits of an experiment: travel of the cart to each side [m], torque [N m], speed of the arm [rad/s], current [A].

    Raises:
        ValueError: one is not a positive number.
    """

    travel: float
    torque: float
    speed: float
    current: float | None = None

    def __post_init__(self) -> None:
        for name in ("travel", "torque", "speed", "current"):
            value = getattr(self, name)
            if not ((name == "current" and value is None) or (np.isfinite(value) and value > 0)):
                raise ValueError(f"{name} limit: is {value}; give a positive number in SI units.")

    def largest_current(self, gain: float) -> float:
        """Return the largest current [A] of a motor of this torque constant [N m/A]."""
        by_torque = self.torque / gain
        return by_torque if self.current is None else min(by_torque, self.current)


class Feasible(NamedTuple):
    """The plans within the limits, the model's motion in each, and why the others were refused."""

    plans: tuple[Plan, ...]
    shown: tuple[Simulation, ...]
    refused: tuple[str, ...]


def default_plans(model: RTAC, limits: Limits, *, sample_time: float, duration: float) -> list[Plan]:
    """Return free decays, square waves, multisines, steady currents, steps and chirps, slow and fast, at several arm angles.

    Currents are sized by what they do to the arm, J theta'' = K_m i, and cut at the limit of torque or current, which the name
    says; what cutting makes alike is there once.
    """
    samples = round(duration / sample_time)
    rest = min(max(5, round(_LEAD / sample_time)), samples // 10)
    time = sample_time * np.arange(samples - rest)
    gain = float(np.asarray(model["torque_constant"]))
    inertia = float(np.asarray(model["arm_inertia"]))
    drag = float(np.asarray(model["arm_viscous.positive"])) if "arm_viscous" in model else 0.0
    largest = limits.largest_current(gain)
    highest = 0.4 / sample_time  # Hz
    plans = [
        Plan(
            f"decay {1e3 * fraction * limits.travel:.3g} mm at {_degrees(angle)}", "free", duration, sample_time,
            initial_position=fraction * limits.travel, initial_angle=angle,
        )
        for fraction, angle in itertools.product(_DISPLACEMENTS, _ANGLES)
    ]  # fmt: skip
    waves: list[tuple[str, np.ndarray]] = []
    for frequency, swing in itertools.product(_SQUARES, _SWINGS):
        # A square wave that begins in mid half-wave swings the arm by tau T^2 / (32 J) without drift.
        amplitude = 32 * frequency**2 * inertia * swing / gain
        if frequency < highest and frequency * duration >= 1:
            sign = np.where((frequency * time + 0.25) % 1 < 0.5, 1.0, -1.0)
            waves.append((f"square {frequency:g} Hz, {swing:g} rad", amplitude * sign))
    for number, (low, high) in enumerate(_BANDS):
        if high < highest and low * duration >= 1:
            for rms in (0.05, 0.2):
                wave = multisine(samples=len(time), sample_time=sample_time, rms=rms, band=(low, high), seed=number)
                waves.append((f"multisine {low:g}-{high:g} Hz, {rms:g} A rms", wave))
    for speed in _SPEEDS:
        level = drag * speed / gain
        if level > 0:
            waves.append((f"steady current to {speed:g} rad per s", np.full(len(time), level)))
            # Forth, off, back, off: the arm runs up, coasts, and comes back slowly through rest.
            turn = np.array([1.0, 0.0, -1.0, 0.0])[np.floor(4 * time / time[-1]).astype(int) % 4]
            waves.append((f"steps to {speed:g} rad per s", level * turn))
    for swing in _SWINGS:
        low, high = 0.5, min(6.0, highest)
        rate = low + (high - low) * time / time[-1]
        phase = 2 * np.pi * np.cumsum(rate) * sample_time
        # The current rises with the frequency squared, so that the arm swings alike throughout.
        wave = inertia * (2 * np.pi * rate) ** 2 * swing / gain * np.cos(phase)
        waves.append((f"chirp {low:g}-{high:g} Hz, {swing:g} rad", wave))
    # What came before a record is not known, so nothing that a delay or a lag would remember may begin with it.
    lead = np.zeros(rest)
    plans += [
        Plan(
            f"{name} at {_degrees(angle)}", "forced", duration, sample_time, np.concatenate([lead, wave]),
            initial_angle=angle,
        )
        for (name, wave), angle in itertools.product(_cut(waves, largest), (_ANGLES[0], _ANGLES[2]))
    ]  # fmt: skip
    return plans


def coasts(experiments: Sequence[Experiment], limits: Limits, *, sample_time: float, duration: float) -> list[Plan]:
    """Return coasts of an arm without a motor from its largest speed and half of it, both ways, as long and three times as long.

    Args:
        experiments: that were recorded, which tell how fast somebody turned it.
        limits: of the speed.
        sample_time: of the plans [s].
        duration: of the shorter ones [s].
    """
    speeds = [
        e.outputs["arm_velocity"].values
        if "arm_velocity" in e.outputs
        else np.gradient(filled(e.outputs["arm_angle"].values), e.sample_time)
        for e in experiments
        if e.outputs.keys() & {"arm_velocity", "arm_angle"}
    ]
    fastest = min(max((float(np.nanmax(np.abs(s))) for s in speeds), default=limits.speed), _MARGIN * limits.speed)
    return [
        Plan(
            f"coast from {sign * part * fastest:.3g} rad per s, {times * duration:.3g} s", "free", times * duration, sample_time,
            cart="clamped", initial_arm_velocity=sign * part * fastest,
        )
        for sign, part, times in itertools.product((1.0, -1.0), (1.0, 0.5), (1.0, 3.0))
    ]  # fmt: skip


def _cut(waves: Sequence[tuple[str, np.ndarray]], largest: float) -> list[tuple[str, np.ndarray]]:
    """Return currents cut at the largest, which is added to the name, each once."""
    found: list[tuple[str, np.ndarray]] = []
    for name, wave in waves:
        cut = np.clip(wave, -largest, largest)
        if not any(np.array_equal(cut, other) for _, other in found):
            found.append((name if np.array_equal(cut, wave) else f"{name}, cut at {largest:.2g} A", cut))
    return found


def held_alike(plans: Sequence[Plan], experiments: Sequence[Experiment]) -> list[Plan]:
    """Return plans whose cart is clamped where it was in all experiments, less decays, in which nothing is left to move then."""
    if not all(e.cart == "clamped" for e in experiments if e.kind != "rest"):
        return list(plans)
    return [dataclasses.replace(p, cart="clamped", initial_position=0.0) for p in plans if p.kind != "free"]


def feasible(model: RTAC, plans: Sequence[Plan], limits: Limits, *, lower: bool, channels: Sequence[str]) -> Feasible:
    """Return the plans that stay within the limits on the model.

    Args:
        model: that the plans are simulated with.
        plans: to choose from.
        limits: of travel, torque, speed and current.
        lower: whether currents may be lowered until they do.
        channels: that are recorded, of which one has to show something.
    """
    plans, asked = list(plans), {plan.name: plan for plan in plans}
    refused: dict[str, str] = {}
    shown: dict[str, Simulation] = {}
    largest = limits.largest_current(float(np.asarray(model["torque_constant"])))
    for attempt in range(_ROUNDS if lower else 1):
        shown = simulate(model, [plan.to_simulate() for plan in plans], start={plan.name: plan.start for plan in plans})
        refused = {}
        for place, plan in enumerate(plans):
            states = shown[plan.name].states
            reach = float(np.max(np.abs(states["cart_position"]))) / (_MARGIN * limits.travel)
            speed = float(np.max(np.abs(states["arm_velocity"]))) / (_MARGIN * limits.speed)
            pull = 0.0 if plan.current is None else float(np.max(np.abs(plan.current))) / largest
            worst = max(reach, speed, pull) if np.isfinite(reach + speed) else np.inf
            if worst <= 1 + 1e-9:
                if not _shows(plan, shown[plan.name], channels):
                    refused[plan.name] = f"{plan.name}: too weak to move anything against friction"
                continue
            what = "travel" if worst == reach else "torque or current" if worst == pull else "speed of the arm"
            refused[plan.name] = f"{plan.name}: breaks the limit of the {what}"
            if lower and plan.current is not None and attempt < _ROUNDS - 1:
                less = max(min(_FEWER, 1 / worst), 0.3)
                plans[place] = dataclasses.replace(plan, current=less * plan.current)
        if not refused:
            break
    kept = _distinct([plan for plan in plans if plan.name not in refused])
    motions = tuple(shown[plan.name] for plan in kept)
    return Feasible(tuple(_named(plan, asked[plan.name]) for plan in kept), motions, tuple(refused.values()))


def _distinct(plans: Sequence[Plan]) -> list[Plan]:
    """Return the plans without those that lowering their current made as good as an earlier one."""
    kept: list[Plan] = []
    for plan in plans:
        if not any(_alike(plan, other) for other in kept):
            kept.append(plan)
    return kept


def _alike(one: Plan, other: Plan) -> bool:
    if one.current is None or other.current is None or one.start != other.start or one.samples != other.samples:
        return False
    return float(np.max(np.abs(one.current - other.current))) <= _ALIKE * float(np.max(np.abs(other.current)))


def predicted(plan: Plan, shown: Simulation, channels: Sequence[str]) -> Experiment:
    """Return a plan as the experiment that the model expects of it; a channel in which nothing moves is left out."""
    return plan.experiment({c: getattr(shown, c) for c in _shows(plan, shown, channels)})


def _shows(plan: Plan, shown: Simulation, channels: Sequence[str]) -> list[str]:
    """Return the channels in which something moves."""
    return [c for c in channels if c not in plan.held and np.ptp(getattr(shown, c)) > 0]


def _named(plan: Plan, asked: Plan) -> Plan:
    if plan.current is None or plan.current is asked.current:
        return plan
    return dataclasses.replace(plan, name=f"{plan.name}, lowered to {np.max(np.abs(plan.current)):.2g} A")


def _degrees(angle: float) -> str:
    return f"{np.degrees(angle):.3g} deg"
