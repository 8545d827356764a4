"""The curve that explains most of what is missing, by a policy."""

from collections.abc import Sequence

from estimators.diagnosis.policy import STANDARD, DiagnosisPolicy
from estimators.misspecification.adequacy import AdequacyTest, excess_of, significant
from estimators.misspecification.static_force import ForceCurve
from rtac_jax import RTAC

SLOPES = {
    ("cart", "cart_position"): "spring_stiffness",
    ("cart", "cart_velocity"): "cart_viscous",
    ("cart", "cart_position, against the motion"): "cart_coulomb",
    ("arm", "arm_angle, against the motion"): "arm_coulomb",
    ("arm", "arm_velocity"): "arm_viscous",
    ("arm", "current"): "torque_constant",
}
"""Parameters and effects that act along the same variable as a missing force, so that only both together are known."""


def shared_with(port: str, variable: str, model: RTAC) -> str:
    """Return what a model estimates along the variable of a force on a port; empty for nothing."""
    name = SLOPES.get((port, variable), "")
    return name if any(free.split(".")[0] == name for free in model.free) else ""


def static_force(
    curves: Sequence[ForceCurve], tests: Sequence[AdequacyTest], policy: DiagnosisPolicy = STANDARD
) -> tuple[ForceCurve | None, bool]:
    """Return the curve that explains most of what is missing, if one does; and whether any explains more than chance."""
    rejecting = next((test for test in tests if test.test == "static force" and test.rejects), None)
    if rejecting is None:
        return None, False
    best = max(significant(curves, rejecting.level), key=lambda c: c.excess, default=None)
    if best is None or not best.excess > policy.static * excess_of(tests):
        return None, True
    return best, True
