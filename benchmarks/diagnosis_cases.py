"""What the study of the diagnosis hides in rigs, and how these are recorded."""

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from estimators.study import naming
from rtac_jax import virtual_rig

SHAKEN = {"force_noise": 1e-3, "torque_noise": 3e-5}
ROTOR_SHARES = (0.15, 0.6)  # of the inertia, where rotor and arm move apart; an effect is looked for from 0.3


@dataclasses.dataclass(frozen=True)
class Case:
    """What a rig hides and how it is recorded."""

    hidden: dict[str, Any] = dataclasses.field(default_factory=dict)
    rest: int = 1
    repeats: int = 1
    write_noise: bool = False  # of the rig without `noise_factor`
    played: Literal["foh", "bl"] | None = None


# Moderate sizes: the base model's error is at most some twenty times the noise.
EFFECTS: dict[str, Case] = {
    "cubic_spring": Case({"cubic_spring": 5e4}),
    "quadratic_spring": Case({"quadratic_spring": 600.0}),
    "force_offset": Case({"force_offset": 0.03}),
    "flexible_mode": Case({"flexible_mass": 0.08, "flexible_frequency": 37.4, "flexible_damping": 0.03}),
    "cart_quadratic_drag": Case({"cart_quadratic_drag": 2.0}),
    "cart_asymmetric_friction": Case({"cart_asymmetry": 0.15}),
    "cart_stribeck": Case({"cart_stribeck": 0.02, "cart_stribeck_velocity": 0.01}),
    "hysteretic_spring": Case({"hysteresis_stiffness": 20.0, "hysteresis_yield": 1e-3}),
    # Bearings whose dry friction is all of it by bristles.
    "cart_presliding": Case({"cart_coulomb": 0.0, "cart_presliding": 0.024, "cart_presliding_yield": 1e-4}),
    "end_stop": Case({"end_stop_travel": 0.012, "end_stop_stiffness": 300.0}),  # a soft bumper
    "arm_coulomb": Case({"arm_coulomb": 4e-4}),
    "arm_stribeck": Case({"arm_stribeck": 4e-4, "arm_stribeck_velocity": 1.0}),
    "arm_presliding": Case({"arm_presliding": 4e-4, "arm_presliding_yield": 0.05}),
    "arm_load_friction": Case({"arm_load_friction": 0.05}),
    "arm_quadratic_drag": Case({"arm_quadratic_drag": 3e-6}),
    "cogging": Case({"cogging_torque": 4e-4, "cogging_order": 7.0, "cogging_phase": 0.7}),
    "torque_ripple": Case({"torque_ripple": 0.03, "torque_ripple_order": 6.0, "torque_ripple_phase": 0.7}),
    "cable_spring": Case({"cable_stiffness": 5e-5}),
    "gravity_tilt": Case({"tilt_across": 0.01}),
    "flexible_shaft": Case({"shaft_stiffness": 0.3, "shaft_damping": 2e-5}),
    "backlash": Case({"backlash": 0.1}),
    "saturation": Case({"saturation": 0.25}),
    "current_lag": Case({"current_lag": 0.01}),
    "input_delay": Case({"input_delay": 0.004}),
    "input_hold": Case(played="foh"),
    "dead_zone": Case({"dead_zone": 0.01}),
    "current_offset": Case({"current_offset": 0.005}),
    "torque_droop": Case({"torque_droop": 0.3}),
    "tacho_bias": Case({"tacho_bias": 0.2}),
    "tacho_gain": Case({"tacho_gain": 1.03}),
    "tacho_lag": Case({"tacho_lag": 0.005}),
    "tacho_delay": Case({"tacho_delay": 0.005}),
    "tacho_ripple": Case({"tacho_ripple": 0.02, "tacho_ripple_phase": 0.7}),
    "lvdt_gain": Case({"lvdt_gain": 1.1}),
    "lvdt_offset": Case({"lvdt_offset": 2e-4}),
    "lvdt_nonlinearity": Case({"lvdt_cubic": 300.0}),
    "lvdt_lag": Case({"lvdt_lag": 0.005}),
    "lvdt_ripple": Case({"lvdt_ripple": 6e-5, "lvdt_ripple_phase": 0.7}),
    "channel_delay": Case({"channel_delay": 0.004}),
    "encoder_gain": Case({"encoder_gain": 1.01, "encoder": True}),
    "encoder_offset": Case({"encoder_offset": 0.05, "encoder": True}),
    "encoder_lag": Case({"encoder_lag": 0.005, "encoder": True}),
    "encoder_ripple": Case({"encoder_ripple": 0.005, "encoder_ripple_phase": 0.7, "encoder": True}),
}
OUTSIDE: dict[str, Case] = {
    "outside: friction along the way": Case({"friction_slope": 2.0}),
    "outside: magnetic detent": Case({"detent_force": 0.05}),
    "outside: floor vibration": Case({"vibration_force": 0.05}),
    "outside: Maxwell spring": Case({"maxwell_stiffness": 10.0}),
    "outside: eddy brake": Case({"eddy_torque": 1e-3, "eddy_velocity": 10.0}),
}
NULL = "nothing, white noise"
NULLS: dict[str, Case] = {
    NULL: Case(),
    "nothing, coloured noise": Case({"noise_correlation": 0.9}),
    "nothing, doubled noise": Case({"noise_factor": 2.0}),
    "nothing, white noise, no rest": Case(rest=0),
    "nothing, coloured noise, no rest": Case({"noise_correlation": 0.9}, rest=0),
    "nothing, white noise, no repeats": Case(repeats=0),
    "nothing, doubled noise, half of it stated, no rest": Case({"noise_factor": 2.0}, rest=0, write_noise=True),
    "nothing, coloured noise, no rest, no repeats": Case({"noise_correlation": 0.9}, rest=0, repeats=0),
}
LITTLE_NOISE = ", coloured noise, no rest, no repeats"
# What keeps noise from being taken for an effect must not take an effect for noise.
LITTLE: dict[str, Case] = {
    effect + LITTLE_NOISE: dataclasses.replace(case, hidden=case.hidden | {"noise_correlation": 0.9}, rest=0, repeats=0)
    for effect, case in EFFECTS.items()
}
PAIRS: dict[str, Case] = {
    f"{one} + {other}": Case(EFFECTS[one].hidden | EFFECTS[other].hidden)
    for one, other in (
        ("cubic_spring", "arm_coulomb"), ("cubic_spring", "current_lag"), ("cubic_spring", "tacho_bias"),
        ("cubic_spring", "gravity_tilt"), ("quadratic_spring", "dead_zone"), ("quadratic_spring", "cogging"),
        ("quadratic_spring", "cart_quadratic_drag"), ("flexible_mode", "arm_coulomb"), ("flexible_mode", "current_offset"),
        ("cart_quadratic_drag", "current_lag"), ("cart_quadratic_drag", "gravity_tilt"), ("cart_stribeck", "tacho_bias"),
        ("hysteretic_spring", "cogging"), ("hysteretic_spring", "input_delay"), ("arm_coulomb", "tacho_lag"),
        ("arm_quadratic_drag", "lvdt_nonlinearity"), ("cable_spring", "dead_zone"), ("gravity_tilt", "torque_droop"),
        ("saturation", "cubic_spring"), ("lvdt_lag", "arm_coulomb"),
    )
}  # fmt: skip


def _itself(size: float) -> float:
    return size


# The rig's name of what the detection limit is about, and its value for a size of the effect's main amplitude.
LIMITS: dict[str, tuple[str, Callable[[float], float]]] = {
    "cubic_spring": ("cubic_spring", _itself),
    "quadratic_spring": ("quadratic_spring", _itself),
    "cart_quadratic_drag": ("cart_quadratic_drag", _itself),
    "cart_asymmetric_friction": ("cart_asymmetry", _itself),
    "arm_coulomb": ("arm_coulomb", _itself),
    "arm_load_friction": ("arm_load_friction", _itself),
    "arm_quadratic_drag": ("arm_quadratic_drag", _itself),
    "current_lag": ("current_lag", _itself),
    "input_delay": ("input_delay", _itself),
    "current_offset": ("current_offset", _itself),
    "torque_droop": ("torque_droop", _itself),
    "tacho_bias": ("tacho_bias", _itself),
    "tacho_gain": ("tacho_gain", lambda size: 1.0 + size),
    "tacho_lag": ("tacho_lag", _itself),
    "tacho_delay": ("tacho_delay", _itself),
    "lvdt_nonlinearity": ("lvdt_cubic", _itself),
    "lvdt_lag": ("lvdt_lag", _itself),
    # What these change is not in proportion to their size.
    "saturation": ("saturation", lambda size: 1.0 / size),
    "backlash": ("backlash", _itself),
    "cable_spring": ("cable_stiffness", _itself),
    "dead_zone": ("dead_zone", _itself),
}
MULTIPLES = {"twice the limit of": 2.0, "a third of the limit of": 1 / 3}
HARD_WORDS = ("short", "mistaken", "gross", "bristles")  # before the names of the cases of diagnosis_hard_cases.py
KINDS = {"effects": EFFECTS, "outside": OUTSIDE, "nothing": NULLS, "pairs": PAIRS, "little": LITTLE}


def cases(draws: range, done: dict[tuple[str, int], dict], kinds: Sequence[str]) -> Iterator[tuple[str, int, Case]]:
    """Name, draw and what is hidden; detection limits last, as they ask what was found before."""
    for draw in draws:
        for kind in KINDS:
            for name, case in KINDS[kind].items() if kind in kinds else ():
                yield name, draw, case
        if "limits" not in kinds:
            continue
        limits = done.get((NULL, draw), {}).get("limits", {})
        for (words, multiple), effect in itertools.product(MULTIPLES.items(), LIMITS):
            if effect in limits:
                field, of_size = LIMITS[effect]
                yield f"{words} {effect}", draw, Case({field: of_size(multiple * limits[effect])})


def hidden_in(name: str) -> list[str]:
    """The effects that a case hides; of one with nothing hidden its name, which no effect has."""
    for words in MULTIPLES:
        name = name.removeprefix(f"{words} ")
    for words in HARD_WORDS:
        name = name.removeprefix(f"{words}: ")
    return [name] if name in NULLS else name.removesuffix(LITTLE_NOISE).split(" + ")


def drawn(case: Case, seed: int, draw: int) -> virtual_rig.Rig:
    """A rig that hides what a case hides; of an odd draw it is shaken."""
    rotor = {"rotor_share": float(np.random.default_rng([seed, 1]).uniform(*ROTOR_SHARES))}
    return dataclasses.replace(virtual_rig.Rig().drawn(seed), **rotor, **(SHAKEN if draw % 2 else {}), **case.hidden)


def kind_of(name: str) -> str:
    """The kind of a case."""
    if (words := name.split(": ")[0]) in HARD_WORDS:
        return words
    return next(kind for kind, members in KINDS.items() if name in members)


def outcome(result: dict, also: Sequence[str] = (), stands_for: Mapping[str, str] | None = None) -> str:
    """Return the worth of a verdict, as in `est.study`, where the rig has what is hidden and these effects.

    An effect that another stands for is to be named by that one.
    """
    named = " + ".join("|".join([step, *result["groups"][step]]) for step in result["steps"])
    hidden = [(stands_for or {}).get(one, one) for one in hidden_in(result["case"])]
    hidden = [one for one in hidden if not (also and one in NULLS)] + [one for one in also if one not in hidden]
    return naming.outcome(" + ".join(hidden), result["verdict"], named)
