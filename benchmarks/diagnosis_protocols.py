"""How the study of the diagnosis records its rigs: other sampling, other sensors, other experiments than the usual ones."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import rtac_jax as rtac
from rtac_jax import virtual_rig
from rtac_jax.measurement.plan import Plan

_SETTLED = 1e-9  # [A]: a current in the loop is found when nothing of it changes by more
_ROUNDS = 60  # twice what the loop of the study took


@dataclasses.dataclass(frozen=True)
class Protocol:
    """How a rig is recorded."""

    sample_time: float = 0.002
    """[s]."""
    duration: float = 5.0
    """Of each run [s]."""
    free: int = 2
    forced: int = 4
    rest: int | None = None
    """Number of rests; None is what the case says."""
    repeats: int | None = None
    """Number of repeats; None is what the case says."""
    sensors: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Fields of the rig that are its sensors'."""
    without: tuple[str, ...] = ()
    """Channels that are not recorded."""
    angles: bool = True
    """Whether somebody notes where the arm begins."""
    constants_std: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Relative standard deviations [1] of the constants, as weighed and stated."""
    feedback: float = 0.0
    """A controller's current per measured arm velocity [A s/rad], subtracted from the planned current."""
    also: tuple[str, ...] = ()
    """Effects that every rig of this protocol has."""
    stands_for: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """By effect, the one of the catalogue that stands for it where this protocol cannot tell more."""


PROTOCOLS: dict[str, Protocol] = {
    "usual": Protocol(),
    "100 Hz": Protocol(sample_time=0.01),
    "2 kHz": Protocol(sample_time=0.0005, duration=3.0),
    "5 kHz": Protocol(sample_time=0.0002, duration=2.0),
    "14 bits": Protocol(sensors={"quantisation_bits": 14}),
    "16 bits, a quarter of the noise": Protocol(
        sensors={"quantisation_bits": 16, "position_noise": 5e-6, "velocity_noise": 0.0125}
    ),
    "one experiment": Protocol(duration=20.0, free=0, forced=1, repeats=0),
    "forced only": Protocol(free=0, forced=6),
    "free only": Protocol(free=6, forced=0, repeats=0, stands_for={"current_offset": "torque_offset"}),
    "no rest, no repeat": Protocol(rest=0, repeats=0),
    "coloured noise, no rest": Protocol(rest=0, sensors={"noise_correlation": 0.9}),
    "coloured noise, no repeat": Protocol(repeats=0, sensors={"noise_correlation": 0.9}),
    "18 x 5,000": Protocol(duration=10.0, free=6, forced=12),
    "encoder, no tachometer": Protocol(sensors={"encoder": True}, without=("arm_velocity",)),
    "angles not noted": Protocol(angles=False),
    "closed loop": Protocol(repeats=0, feedback=0.001),
    "weighed constants": Protocol(constants_std={"total_mass": 1e-3, "arm_inertia": 1e-2}),
    # One bit of the tachometer is two and a half times its noise.
    "coarse tachometer with ripple": Protocol(
        sensors={"velocity_range": 250.0, "tacho_ripple": 0.01, "tacho_ripple_phase": 0.7}, also=("tacho_ripple",)
    ),
}


def plans_of(protocol: Protocol, *, seed: int, rest: int, repeats: int, played: Any) -> list[Plan]:
    """Return the plans of a protocol; rests and repeats are the case's where the protocol leaves them open."""
    return virtual_rig.standard_plans(
        seed=seed,
        sample_time=protocol.sample_time,
        duration=protocol.duration,
        free=protocol.free,
        forced=protocol.forced,
        rest=rest if protocol.rest is None else protocol.rest,
        repeats=(repeats if protocol.repeats is None else protocol.repeats) if protocol.forced else 0,
        played=played,
    )


def recorded(
    protocol: Protocol, rig: virtual_rig.Rig, plans: Sequence[Plan], *, seed: int, write_noise: bool = False
) -> rtac.Recording:
    """Record a rig as a protocol says.

    A controller in the loop is found by repetition: the same noise, and the current that the last repetition's outputs
    ask for. What an output changes comes later, so that every repetition is right for longer.
    """
    stds = {name: share * getattr(rig, name) for name, share in protocol.constants_std.items()}

    def record(now: Sequence[Plan]) -> rtac.Recording:
        return virtual_rig.record(rig, now, seed=seed, write_noise=write_noise, constants_std=stds)

    made = record(plans)
    change = np.inf if protocol.feedback else 0.0
    now = plans
    for _ in range(_ROUNDS):
        if change < _SETTLED:
            break
        before, now = now, [_in_the_loop(plan, made, protocol.feedback) for plan in plans]
        change = max(_apart(one, other) for one, other in zip(now, before, strict=True))
        made = record(now)
    else:
        raise ArithmeticError(f"the current in the loop still changes by {change:.1g} A.")
    kept = _without(made, protocol.without)
    if protocol.angles:
        return kept
    bare = tuple(dataclasses.replace(e, initial_arm_angle=None) for e in kept)
    return dataclasses.replace(kept, experiments=bare)


def _in_the_loop(plan: Plan, made: rtac.Recording, feedback: float) -> Plan:
    if plan.kind != "forced":
        return plan
    planned = np.zeros(plan.samples) if plan.current is None else plan.current
    return dataclasses.replace(plan, current=planned - feedback * made[plan.name].outputs["arm_velocity"].values)


def _apart(one: Plan, other: Plan) -> float:
    if one.current is None or other.current is None:
        return 0.0
    return float(np.max(np.abs(one.current - other.current)))


def _without(recording: rtac.Recording, channels: Sequence[str]) -> rtac.Recording:
    def kept(one: rtac.Experiment) -> rtac.Experiment:
        outputs = {name: signal for name, signal in one.outputs.items() if name not in channels}
        return dataclasses.replace(one, outputs=outputs)

    return dataclasses.replace(recording, experiments=tuple(kept(one) for one in recording)) if channels else recording
