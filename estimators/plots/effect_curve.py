"""A fitted effect as the curve that the missing force should be, where it is a static force in that variable."""

from typing import Any

import numpy as np
from jaxtyping import Float

from estimators.misspecification.static_force import ForceCurve
from rtac_jax.effects import DryFriction, Effect, Force, Motion

_POINTS = 101
_MOVING = {"cart": "cart_velocity", "arm": "arm_velocity"}
# What the model's own parameters take up of a force at each port: stiffness, friction, torque constant.
_OWN = {
    ("cart", "cart_position"): (lambda x: x,),
    ("cart", "cart_velocity"): (lambda x: x, np.sign),
    ("cart", "cart_position, against the motion"): (np.ones_like,),
    ("arm", "arm_velocity"): (lambda x: np.maximum(x, 0.0), lambda x: np.minimum(x, 0.0)),
    ("arm", "current"): (lambda x: x,),
}

Curve = Float[np.ndarray, " point"]


def effect_curve(effect: Effect, curve: ForceCurve) -> tuple[Curve, Curve] | None:
    """Return the variable and the effect's force there [SI units]; None where it is no static force in this variable.

    What the model's own parameters would take up of it, such as the slope of a spring, is taken off, as the data cannot
    show that part of a missing force either: its amount is that for which the rest comes nearest to the curve.
    """
    if effect.states or not isinstance(effect, (Force, DryFriction)):
        return None
    dense = np.linspace(curve.at[0], curve.at[-1], _POINTS)
    shown = _static(effect, curve, dense)
    at_knots = _static(effect, curve, curve.at)
    if shown is None or at_knots is None or not np.any(shown):
        return None
    own = _own(curve, curve.at)
    if own.size:
        weight = 1.0 / curve.std
        taken, *_ = np.linalg.lstsq(own * weight[:, None], (curve.force - at_knots) * weight, rcond=None)
        shown = shown + _own(curve, dense) @ taken
    return dense, shown


def _own(curve: ForceCurve, at: Curve) -> Float[np.ndarray, "point part"]:
    columns = [part(at) for part in _OWN.get((curve.port, curve.variable), ())]
    return np.stack(columns, axis=1) if columns else np.zeros((len(at), 0))


def _static(effect: Force | DryFriction, curve: ForceCurve, at: Curve) -> Curve | None:
    """Return the force over the variable; None if it depends on anything else, or does not act at this port."""
    variable, _, against = curve.variable.partition(", ")
    port = ("cart", "arm").index(curve.port)
    found = []
    for other in (0.3, -0.7):  # of whatever else may matter, in SI units; a static force is the same for both
        known: dict[str, Any] = dict.fromkeys(
            ("cart_position", "cart_velocity", "arm_angle", "arm_velocity", "current"), other
        )
        known[variable] = at
        if against:
            known[_MOVING[curve.port]] = -1.0  # so that the force along the motion is minus its level
        speed = known[_MOVING[curve.port]]
        motion = Motion(**known, sin_angle=np.sin(known["arm_angle"]), cos_angle=np.cos(known["arm_angle"]), body=None)  # type: ignore[arg-type] - a force that asks for the body is refused below
        try:
            if isinstance(effect, DryFriction):
                force = -np.asarray(effect.levels(motion, ())[port]) * np.sign(speed)
            else:
                force = np.asarray(effect.force(motion, ())[port])
        except AttributeError:  # a force on the mass or by the motor of the body, which a diagnosis does not keep
            return None
        found.append(np.broadcast_to(np.asarray(force, dtype=float), np.shape(at)))
    first, second = found
    return (
        first if np.allclose(first, second, rtol=1e-9, atol=1e-12 * float(np.max(np.abs(first), initial=0.0))) else None
    )
