"""Assumptions of the paper's model about each estimated quantity, and the effects that break them."""

from collections.abc import Collection

from rtac_jax.effects import CATALOGUE

_INTEGRATED = "the arm's angle is the integral of what the tachometer shows, and the plane is level"
_LEVEL = "the plane is level, and all channels are read at the same instants"
_LINEAR_SPRING = (
    "the spring is linear and all of the mass moves with the cart",
    ("cubic_spring", "quadratic_spring", "hysteretic_spring", "flexible_mode", "lvdt_nonlinearity", "end_stop"),
)
_CART_FRICTION = (
    "the cart's friction is viscous and dry only",
    (
        "cart_quadratic_drag",
        "cart_stribeck",
        "cart_asymmetric_friction",
        "cart_presliding",
        "hysteretic_spring",
        "flexible_mode",
        "cubic_spring",
    ),
)
_ARM_FRICTION = (
    "the arm's friction is viscous, with one coefficient for each direction",
    (
        "arm_coulomb",
        "arm_quadratic_drag",
        "arm_stribeck",
        "arm_load_friction",
        "arm_presliding",
        "cogging",
        "cable_spring",
        "tacho_bias",
        "current_offset",
    ),
)

_ASSUMES: dict[str, tuple[str, tuple[str, ...]]] = {
    "spring_stiffness": _LINEAR_SPRING,
    "natural frequency": _LINEAR_SPRING,
    "cart_viscous.coefficient": _CART_FRICTION,
    "damping ratio": _CART_FRICTION,
    "cart_coulomb.level": (
        "the cart's dry friction is the same at all speeds",
        (
            "cart_stribeck",
            "cart_presliding",
            "cart_quadratic_drag",
            "hysteretic_spring",
            "gravity_tilt",
            "cubic_spring",
        ),
    ),
    "eccentric_moment": (
        _INTEGRATED,
        ("tacho_bias", "tacho_lag", "tacho_delay", "gravity_tilt", "channel_delay"),
    ),
    "torque_constant": (
        "the torque is proportional to the recorded current, at once and at all amplitudes",
        (
            "current_lag",
            "input_delay",
            "current_offset",
            "torque_droop",
            "arm_load_friction",
            "dead_zone",
            "saturation",
            "tacho_lag",
            "tacho_delay",
            "cogging",
            "torque_ripple",
            "cable_spring",
        ),
    ),
    "arm_viscous.positive": _ARM_FRICTION,
    "arm_viscous.negative": _ARM_FRICTION,
}
"""By name: the assumption in words, and ids of effects, the likeliest first."""
_FORCE = ("force_delay", "force_lag", "force_saturation", "force_dead_zone", "force_droop")
_BY_FORCE = ("spring_stiffness", "natural frequency", "cart_viscous.coefficient", "damping ratio", "cart_coulomb.level")


def assumed(name: str, channels: Collection[str]) -> tuple[str, tuple[str, ...]] | None:
    """Return what the model assumes about a quantity, and the ids of effects that break it; None where nothing is known.

    Args:
        name: of the quantity.
        channels: that were recorded; effects of a sensor that the rig does not have, and of a force that nobody applies, are left
            out.
    """
    if name not in _ASSUMES:
        return None
    words, effects = _ASSUMES[name]
    if words == _INTEGRATED and ("arm_angle" in channels or "arm_velocity" not in channels):
        words = _LEVEL
    if name in _BY_FORCE and "disturbance_force" in channels:
        words, effects = f"{words}, and the applied force acts as it was recorded", (*effects, *_FORCE)
    needs = {effect: CATALOGUE[effect].needs_channel for effect in effects}
    return words, tuple(effect for effect, channel in needs.items() if channel is None or channel in channels)
