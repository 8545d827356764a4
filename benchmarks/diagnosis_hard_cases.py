"""Recordings that ordinary cases are not: short ones, mistaken ones, gross effects and friction by bristles.

They are what rules guard against that change no verdict of the ordinary cases, so that the ablation can say what each is worth.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

from diagnosis_cases import EFFECTS, Case, drawn

import rtac_jax as rtac
from rtac_jax import virtual_rig

_TWO_SECONDS: dict[str, Any] = {"duration": 2.0, "free": 2, "forced": 2}


def _short(rig: virtual_rig.Rig, seed: int) -> rtac.Recording:
    """The training half of four runs of two seconds."""
    plans = virtual_rig.standard_plans(seed=seed + 1, **_TWO_SECONDS)
    return virtual_rig.record(rig, plans, seed=seed + 2).split()[0]


def _with_current(recording: rtac.Recording, factor: float) -> rtac.Recording:
    return dataclasses.replace(recording, experiments=tuple(_scaled(e, "inputs", "current", factor) for e in recording))


def _with_output(recording: rtac.Recording, channel: str, factor: float) -> rtac.Recording:
    return dataclasses.replace(recording, experiments=tuple(_scaled(e, "outputs", channel, factor) for e in recording))


def _scaled(experiment: Any, group: str, channel: str, factor: float) -> Any:
    signals = dict(getattr(experiment, group))
    if channel in signals:
        signals[channel] = dataclasses.replace(signals[channel], values=factor * signals[channel].values)
    return dataclasses.replace(experiment, **{group: signals})


def _weighed(recording: rtac.Recording, name: str, factor: float) -> rtac.Recording:
    return dataclasses.replace(recording, rig={**recording.rig, name: factor * recording.rig[name]})


def _dominated(current_rms: float, speed: float = 0.0) -> Callable[[virtual_rig.Rig, int], rtac.Recording]:
    """A free decay and two forced runs whose arm begins near 0.4 rad, maybe at a speed."""

    def made(rig: virtual_rig.Rig, seed: int) -> rtac.Recording:
        plans = virtual_rig.standard_plans(
            seed=seed + 1, sample_time=0.005, duration=5.0, free=1, forced=2, current_rms=current_rms
        )
        starts = [
            dataclasses.replace(plan, initial_angle=0.4 + 0.3 * n, initial_arm_velocity=speed * (-1) ** n)
            for n, plan in enumerate(plans)
        ]
        return virtual_rig.record(rig, starts, seed=seed + 2)

    return made


def _mistaken(change: Callable[[rtac.Recording], rtac.Recording]) -> Callable[[virtual_rig.Rig, int], rtac.Recording]:
    return lambda rig, seed: change(_short(rig, seed))


def _usual(rig: virtual_rig.Rig, seed: int) -> rtac.Recording:
    plans = virtual_rig.standard_plans(
        seed=seed + 1, sample_time=0.002, duration=5.0, free=2, forced=4, rest=1, repeats=1
    )
    return virtual_rig.record(rig, plans, seed=seed + 2)


@dataclasses.dataclass(frozen=True)
class HardCase(Case):
    """A case with a recording of its own."""

    made: Callable[[virtual_rig.Rig, int], rtac.Recording] = _short


SHORT = {
    **{
        f"short: {effect}": HardCase(EFFECTS[effect].hidden)
        for effect in ("arm_coulomb", "cubic_spring", "tacho_gain", "current_lag", "flexible_mode", "backlash")
    },
    "short: nothing": HardCase(),
}
MISTAKEN = {
    "mistaken: current of the other sign": HardCase(made=_mistaken(lambda r: _with_current(r, -1.0))),
    "mistaken: mass ten times": HardCase(made=_mistaken(lambda r: _weighed(r, "total_mass", 10.0))),
    "mistaken: positions in tenths of a metre": HardCase(
        made=_mistaken(lambda r: _with_output(r, "cart_position", 10.0))
    ),
    "mistaken: speed of the other sign": HardCase(made=_mistaken(lambda r: _with_output(r, "arm_velocity", -1.0))),
}
GROSS = {
    "gross: gravity_tilt": HardCase({"tilt_across": math.pi / 2}, made=_dominated(0.16)),
    "gross: cable_spring": HardCase({"cable_stiffness": 0.05, "cable_home": 0.4}, made=_dominated(0.16)),
    "gross: one_sided_spring": HardCase({"one_sided_spring": 130.0}, made=_dominated(0.16)),
    "gross: arm_coulomb": HardCase({"arm_coulomb": 0.013}, made=_dominated(0.016, 30.0)),
}
BRISTLES = {
    "bristles: cart_presliding": HardCase(
        {"cart_coulomb": 0.0, "cart_presliding": 0.024, "cart_presliding_yield": 1e-5}, made=_usual
    ),
    "bristles: arm_presliding": HardCase({"arm_presliding": 4e-4, "arm_presliding_yield": 0.05}, made=_usual),
}
HARD: Mapping[str, dict[str, HardCase]] = {
    "short": SHORT, "mistaken": MISTAKEN, "gross": GROSS, "bristles": BRISTLES,
}  # fmt: skip


def recording_of(case: HardCase, seed: int, draw: int) -> rtac.Recording:
    """Record a hard case; of an odd draw the rig is shaken."""
    return case.made(drawn(case, seed, draw), seed)
