"""Testability: which effects a recording could show at all."""

from collections.abc import Sequence

import numpy as np

from rtac_jax.effects import Effect
from rtac_jax.measurement import Experiment

_NEEDS = {"tacho": "arm_velocity", "encoder": "arm_angle", "lvdt": "cart_position", "channel": "cart_position"}
"""Which output a sensor effect needs, by the first word of its id."""


def can_show(effect: type[Effect], experiments: Sequence[Experiment]) -> bool:
    """Return whether what the effect acts on moves, or is measured, in any experiment."""
    arm = any(e.arm == "free" for e in experiments)
    cart = any(e.cart == "free" for e in experiments)
    driven = {name for e in experiments for name, signal in e.inputs.items() if np.any(signal.values)}
    measured = {name for e in experiments for name in e.outputs}
    if effect.port == "input":
        return bool(driven)
    if effect.port == "actuator":
        return "current" in driven and arm
    if effect.port == "sensor":
        needs = _NEEDS.get(effect.id.split("_")[0])
        return (needs is None or needs in measured) and (arm or needs != "arm_velocity")
    if effect.id.startswith("arm_") or effect.port == "arm":
        return arm
    if effect.port == "cart":
        return cart
    return True
