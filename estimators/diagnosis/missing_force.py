"""The curve that explains most of what is missing, by a policy."""

from collections.abc import Sequence

from estimators.core.data import moving, pieces
from estimators.core.sensor_noise import noise_levels
from estimators.diagnosis.policy import STANDARD, DiagnosisPolicy
from estimators.misspecification.adequacy import AdequacyTest, excess_of, significant
from estimators.misspecification.equation_curves import EquationCurve, equation_curves
from estimators.misspecification.static_force import ForceCurve
from rtac_jax import RTAC
from rtac_jax.measurement import Recording

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


def significant_equation_curves(
    model: RTAC, recording: Recording, policy: DiagnosisPolicy = STANDARD, *, alone: bool = False
) -> list[EquationCurve]:
    """Return the curves that explain the error of the equations of motion, the best first.

    Each by very strong evidence, that is alike over stretches of time.

    Args:
        model: as it was fitted.
        recording: that was fitted.
        policy: the thresholds.
        alone: those only that explain most of the error of their equation.
    """
    found = equation_curves(model, pieces(moving(recording)), noise_levels(recording.experiments))
    least = policy.static if alone else 0.0
    large = [one for one in found if one.curve.score > policy.bic_gain and one.fraction > least]
    alike = significant([one.curve for one in found], policy.critical.level)
    return [one for one in large if any(one.curve is curve for curve in alike)]
