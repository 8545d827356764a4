"""The catalogue: one small immutable class per physical effect."""

from rtac_jax.effects._interface import (
    PORTS,
    Actuator,
    DryFriction,
    Effect,
    Force,
    Impact,
    Input,
    Motion,
    Outputs,
    Sensor,
    States,
    in_parts,
)
from rtac_jax.effects.actuator import CurrentLag, CurrentOffset, DeadZone, Saturation, TorqueDroop
from rtac_jax.effects.arm_friction import ArmCoulomb, ArmLoadFriction, ArmQuadraticDrag, ArmStribeck, ArmViscous
from rtac_jax.effects.between_samples import InputDelay, InputHold
from rtac_jax.effects.cart_friction import (
    CartAsymmetricFriction,
    CartCoulomb,
    CartQuadraticDrag,
    CartStribeck,
    CartViscous,
)
from rtac_jax.effects.cogging import Cogging, SecondCogging, TorqueRipple
from rtac_jax.effects.flexible_mode import FlexibleMode
from rtac_jax.effects.force_drive import ForceDeadZone, ForceDelay, ForceDroop, ForceLag, ForceSaturation
from rtac_jax.effects.gravity_tilt import GravityTilt
from rtac_jax.effects.hysteretic_spring import HystereticSpring
from rtac_jax.effects.presliding import ArmPresliding, CartPresliding
from rtac_jax.effects.sensor_ripple import EncoderRipple, LvdtRipple, TachoRipple
from rtac_jax.effects.sensors import (
    ChannelDelay,
    EncoderGain,
    EncoderLag,
    EncoderOffset,
    LvdtGain,
    LvdtLag,
    LvdtNonlinearity,
    LvdtOffset,
    TachoBias,
    TachoDelay,
    TachoGain,
    TachoLag,
)
from rtac_jax.effects.shaft import Backlash, FlexibleShaft
from rtac_jax.effects.spline_force import SplineForce
from rtac_jax.effects.springs import CableSpring, CubicSpring, EndStop, ForceOffset, QuadraticSpring, TorqueOffset

CATALOGUE: dict[str, type[Effect]] = {
    effect.id: effect
    for effect in (
        CartViscous,
        CartCoulomb,
        CartStribeck,
        CartPresliding,
        CartAsymmetricFriction,
        CartQuadraticDrag,
        CubicSpring,
        QuadraticSpring,
        HystereticSpring,
        ForceOffset,
        FlexibleMode,
        EndStop,
        ArmViscous,
        ArmCoulomb,
        ArmStribeck,
        ArmPresliding,
        ArmLoadFriction,
        ArmQuadraticDrag,
        Cogging,
        SecondCogging,
        TorqueRipple,
        CableSpring,
        TorqueOffset,
        GravityTilt,
        Backlash,
        FlexibleShaft,
        InputHold,
        InputDelay,
        ForceDelay,
        ForceLag,
        ForceSaturation,
        ForceDeadZone,
        ForceDroop,
        Saturation,
        CurrentLag,
        CurrentOffset,
        DeadZone,
        TorqueDroop,
        TachoLag,
        TachoDelay,
        TachoRipple,
        TachoGain,
        TachoBias,
        LvdtLag,
        ChannelDelay,
        LvdtNonlinearity,
        LvdtRipple,
        LvdtGain,
        LvdtOffset,
        EncoderLag,
        EncoderRipple,
        EncoderGain,
        EncoderOffset,
    )
}
"""Every effect that the package knows, by id; inputs, actuators and sensors in the order in which they follow each other."""


def effect_class(name: str) -> type[Effect]:
    """Return the effect class of the catalogue with this id.

    Raises:
        ValueError: there is none.
    """
    if name not in CATALOGUE:
        raise ValueError(f"effect {name!r} is not in the catalogue; choose one of {', '.join(CATALOGUE)}.")
    return CATALOGUE[name]


__all__ = [
    "CATALOGUE",
    "PORTS",
    "Actuator",
    "ArmCoulomb",
    "ArmLoadFriction",
    "ArmPresliding",
    "ArmQuadraticDrag",
    "ArmStribeck",
    "ArmViscous",
    "Backlash",
    "CableSpring",
    "CartAsymmetricFriction",
    "CartCoulomb",
    "CartPresliding",
    "CartQuadraticDrag",
    "CartStribeck",
    "CartViscous",
    "ChannelDelay",
    "Cogging",
    "CubicSpring",
    "CurrentLag",
    "CurrentOffset",
    "DeadZone",
    "DryFriction",
    "Effect",
    "EncoderGain",
    "EncoderLag",
    "EncoderOffset",
    "EncoderRipple",
    "EndStop",
    "FlexibleMode",
    "FlexibleShaft",
    "Force",
    "ForceDeadZone",
    "ForceDelay",
    "ForceDroop",
    "ForceLag",
    "ForceOffset",
    "ForceSaturation",
    "GravityTilt",
    "HystereticSpring",
    "Impact",
    "Input",
    "InputDelay",
    "InputHold",
    "LvdtGain",
    "LvdtLag",
    "LvdtNonlinearity",
    "LvdtOffset",
    "LvdtRipple",
    "Motion",
    "Outputs",
    "QuadraticSpring",
    "Saturation",
    "SecondCogging",
    "Sensor",
    "SplineForce",
    "States",
    "TachoBias",
    "TachoDelay",
    "TachoGain",
    "TachoLag",
    "TachoRipple",
    "TorqueDroop",
    "TorqueOffset",
    "TorqueRipple",
    "effect_class",
    "in_parts",
]
