"""The catalogue: one small immutable class per physical effect."""

from rtac_jax.effects._interface import Actuator, DryFriction, Effect, Force, Motion, Outputs, Sensor, States
from rtac_jax.effects.actuator import CurrentLag, CurrentOffset, DeadZone
from rtac_jax.effects.arm_friction import ArmCoulomb, ArmViscous
from rtac_jax.effects.cart_friction import CartCoulomb, CartQuadraticDrag, CartViscous
from rtac_jax.effects.cogging import Cogging
from rtac_jax.effects.flexible_mode import FlexibleMode
from rtac_jax.effects.gravity_tilt import GravityTilt
from rtac_jax.effects.sensors import TachoBias
from rtac_jax.effects.springs import CubicSpring, ForceOffset, QuadraticSpring

CATALOGUE: dict[str, type[Effect]] = {
    effect.id: effect
    for effect in (
        CartViscous,
        CartCoulomb,
        CartQuadraticDrag,
        CubicSpring,
        QuadraticSpring,
        ForceOffset,
        FlexibleMode,
        ArmViscous,
        ArmCoulomb,
        Cogging,
        GravityTilt,
        CurrentLag,
        DeadZone,
        CurrentOffset,
        TachoBias,
    )
}
"""Every effect that the package knows, by id."""


def effect_class(name: str) -> type[Effect]:
    """The effect of the catalogue with this id.

    Raises:
        ValueError: there is none.
    """
    if name not in CATALOGUE:
        raise ValueError(f"effect {name!r} is not in the catalogue; choose one of {', '.join(CATALOGUE)}.")
    return CATALOGUE[name]


__all__ = [
    "CATALOGUE",
    "Actuator",
    "ArmCoulomb",
    "ArmViscous",
    "CartCoulomb",
    "CartQuadraticDrag",
    "CartViscous",
    "Cogging",
    "CubicSpring",
    "CurrentLag",
    "CurrentOffset",
    "DeadZone",
    "DryFriction",
    "Effect",
    "FlexibleMode",
    "Force",
    "ForceOffset",
    "GravityTilt",
    "Motion",
    "Outputs",
    "QuadraticSpring",
    "Sensor",
    "States",
    "TachoBias",
    "effect_class",
]
