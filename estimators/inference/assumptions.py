"""Assumptions of the paper's model about each estimated quantity, and the effects that break them."""

_LINEAR_SPRING = (
    "the spring is linear and all of the mass moves with the cart",
    ("cubic_spring", "quadratic_spring", "hysteretic_spring", "flexible_mode", "lvdt_nonlinearity", "end_stop"),
)
_CART_FRICTION = (
    "the cart's friction is viscous and dry only",
    ("cart_quadratic_drag", "cart_stribeck", "cart_presliding", "hysteretic_spring", "flexible_mode", "cubic_spring"),
)
_ARM_FRICTION = (
    "the arm's friction is viscous, with one coefficient for each direction",
    (
        "arm_coulomb",
        "arm_quadratic_drag",
        "arm_stribeck",
        "arm_presliding",
        "cogging",
        "cable_spring",
        "tacho_bias",
        "current_offset",
    ),
)

ASSUMES: dict[str, tuple[str, tuple[str, ...]]] = {
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
        "the arm's angle is the integral of what the tachometer shows, and the plane is level",
        ("tacho_bias", "tacho_lag", "gravity_tilt", "channel_delay"),
    ),
    "torque_constant": (
        "the torque is proportional to the recorded current, at once and at all amplitudes",
        (
            "current_lag",
            "input_delay",
            "current_offset",
            "torque_droop",
            "dead_zone",
            "saturation",
            "tacho_lag",
            "cogging",
            "cable_spring",
        ),
    ),
    "arm_viscous.positive": _ARM_FRICTION,
    "arm_viscous.negative": _ARM_FRICTION,
}
"""By name: the assumption in words, and ids of effects, the likeliest first."""
