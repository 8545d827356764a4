"""The arm's angle where an experiment begins that tells nothing of it, in closed form."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from estimators.closed_form.modulating_functions import NEAR_WEAK, WeakMotion, integrated_terms, weak_motion
from estimators.closed_form.regressors import Terms
from estimators.closed_form.two_stage import solve_each, tells_of_cart
from rtac_jax import RTAC
from rtac_jax.measurement import Experiment

# Eccentric moment over its standard deviation above which its direction is taken for an angle. Of 241 that were so with a cable,
# a tilt, dry friction, a cubic spring or nothing missing the worst was 0.31 rad off; with 3 two of four small decays
# more were off by more than half a radian (docs/study_log.md, angles that nobody measured).
_SEEN = 10.0
_MORE = 3  # torques that a model may lack
_CART, _ARM = ("viscous", "dry", "spring"), ("current", "positive", "negative")


def with_initial_angles(
    model: RTAC, experiments: Sequence[Experiment], levels: Mapping[str, float]
) -> list[Experiment]:
    """Return the experiments, with an angle at the start where the arm's motion is measured and its angle is not.

    Both equations of motion are linear in the two components of the eccentric moment along and across where the arm begins, and
    their direction is its angle there. An experiment in which the arm hardly moves the cart stays as it is.

    Args:
        model: gives total mass and arm inertia.
        experiments: moving ones.
        levels: noise of each channel, SI units.
    """
    return [
        dataclasses.replace(e, initial_arm_angle=angle)
        if not angle_told(e) and (angle := _angle(model, e, levels)) is not None
        else e
        for e in experiments
    ]


def angle_told(experiment: Experiment) -> bool:
    """Return whether the arm's angle is known, or whether no angle can be found: the arm is locked, or nobody saw it."""
    known = experiment.initial_arm_angle is not None or "arm_angle" in experiment.outputs
    return known or experiment.arm != "free" or "arm_velocity" not in experiment.outputs


def _angle(model: RTAC, experiment: Experiment, levels: Mapping[str, float]) -> float | None:
    try:
        begun = [dataclasses.replace(experiment, initial_arm_angle=angle) for angle in (0.0, 0.5 * np.pi)]
        motions = [weak_motion(e) for e in begun]
        along, across = (
            integrated_terms(e, levels, near_zero=NEAR_WEAK, motion=motion)
            for e, motion in zip(begun, motions, strict=True)
        )
    except ValueError:
        return None  # too short for test functions, or the cart's motion was not measured
    if not tells_of_cart(along):
        return None
    mass, inertia = (float(np.mean(np.asarray(model[name]))) for name in ("total_mass", "arm_inertia"))
    parts = [_of_cart(along, across, mass), _of_arm(along, across, inertia, motions[0])]
    # The equations by their accelerations first, then each by its own error.
    found = _solved(parts, (1.0 / mass, 1.0 / inertia))[0]
    found, deviation = _solved(
        parts, [1.0 / max(float(np.sqrt(np.mean((t - m @ found) ** 2))), 1e-300) for m, t in parts]
    )
    moment = float(np.hypot(*found[:2]))
    if moment < _SEEN * deviation:
        return None
    return float(np.arctan2(found[1], found[0]))


def _solved(parts: Sequence[tuple[np.ndarray, np.ndarray]], weights: Sequence[float]) -> tuple[np.ndarray, float]:
    """Return the solution of both weighted equations, and the standard deviation of the moment's components together."""
    matrix, target = (np.concatenate([w * part[n] for w, part in zip(weights, parts, strict=True)]) for n in range(2))
    _, found = solve_each([(matrix, target, matrix)])
    size = np.sqrt(np.mean(matrix**2, axis=0))
    size = np.where(size > 0, size, 1.0)
    covariance = np.linalg.pinv((matrix / size).T @ (matrix / size)) / np.outer(size, size)
    return found, float(np.sqrt(np.mean((target - matrix @ found) ** 2) * np.trace(covariance[:2, :2])))


def _of_cart(along: Terms, across: Terms, mass: float) -> tuple[np.ndarray, np.ndarray]:
    """Return regressors and target of the cart's equation; the moment's components come first."""
    rows = along.sliding
    columns = [along.cart["swing"], across.cart["swing"], *(along.cart[name] for name in _CART)]
    columns += [np.zeros(len(rows))] * (len(_ARM) + _MORE)
    return np.stack(columns, axis=1)[rows], (along.cart["force"] - mass * along.cart["mass"])[rows]


def _of_arm(along: Terms, across: Terms, inertia: float, motion: WeakMotion) -> tuple[np.ndarray, np.ndarray]:
    """Return regressors and target of the arm's equation.

    With them torques that a model may lack, a constant one, one against the angle and one against the motion: unexplained they
    would hide in the moment.
    """
    count = len(along.arm["inertia"])
    columns = [along.arm["reaction"], across.arm["reaction"], *[np.zeros(count)] * len(_CART)]
    columns += [-along.arm["current"], along.arm["positive"], along.arm["negative"]]
    columns += [motion.on_arm(x) for x in (np.ones(len(motion.angle)), motion.angle, np.sign(motion.turning))]
    return np.stack(columns, axis=1), -inertia * along.arm["inertia"]
