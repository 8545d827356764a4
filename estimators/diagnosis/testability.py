"""Testability: which effects a recording could show at all."""

from collections.abc import Sequence

import numpy as np

from rtac_jax.effects import Effect
from rtac_jax.measurement import Experiment


def stood_for(effect: type[Effect], experiments: Sequence[Experiment]) -> bool:
    """Return whether another effect is the same as this one, since a current drives the motor."""
    return effect.undriven and any(np.any(e.inputs["current"].values) for e in experiments if "current" in e.inputs)


def _turns(experiment: Experiment) -> float:
    """Return by how many turns the arm moved, by its angle or its speed; 0 where neither was measured."""
    if "arm_angle" in experiment.outputs:
        angle = experiment.outputs["arm_angle"].values
    elif "arm_velocity" in experiment.outputs:
        angle = np.cumsum(np.nan_to_num(experiment.outputs["arm_velocity"].values)) * experiment.sample_time
    else:
        return 0.0
    return float(np.nanmax(angle) - np.nanmin(angle)) / (2 * np.pi)


def can_show(effect: type[Effect], experiments: Sequence[Experiment]) -> bool:
    """Return whether what the effect acts on moves or is driven, and what it needs is measured, in any experiment.

    All are declarations of the effect: its `port`, its `needs_channel`, its `most_turns` and whether it is one of `undriven` motors
    only.
    """
    arm = any(e.arm == "free" for e in experiments)
    cart = any(e.cart == "free" for e in experiments)
    driven = {name for e in experiments for name, signal in e.inputs.items() if np.any(signal.values)}
    measured = {name for e in experiments for name in e.outputs}
    if effect.needs_channel is not None and effect.needs_channel not in measured:
        return False
    if stood_for(effect, experiments) or max(map(_turns, experiments)) > effect.most_turns:
        return False
    if effect.port == "input":
        return bool(driven)
    if effect.port == "actuator":
        return "current" in driven and arm
    if effect.port == "force drive":
        return "disturbance_force" in driven and cart
    if effect.port == "sensor":
        return arm or effect.needs_channel != "arm_velocity"
    if effect.port in ("arm", "arm and cart"):  # beside a locked arm the latter is another effect of the cart's
        return arm
    if effect.port == "cart":
        return cart
    return True
