"""The places around which a cart on a spring can move, by the mean of its equation, which holds without sliding too."""

from collections.abc import Mapping

import numpy as np

from rtac_jax.measurement import Experiment

# Times what the equation in the mean allows, as it is computed from estimated coefficients.
_SLACK = 2.0
# Of the amplitude: a spring that is softer on one side shifts the mean, by a twentieth where it is a tenth softer.
ONE_SIDED = 0.25


def distance_from_equilibrium(experiment: Experiment, coefficients: Mapping[str, float]) -> float | None:
    """Return by how much a cart's mean position is off the equilibrium [m]; None where dry friction and inertia allow it.

    Over a time T the mean of equation (1), divided by M+m, is k/(M+m) (mean q - offset) = -d/(M+m) mean sgn q' - what
    velocities and position changed by, over T. So dry friction allows d/k at most, and the ends of the record little
    more; velocities are bounded by the amplitude and the resonance.

    Args:
        experiment: with a measured cart position.
        coefficients: of the equations divided by M+m, as `equation_error.COEFFICIENTS` names them.
    """
    spring = coefficients["spring"]
    if spring <= 0 or "cart_position" not in experiment.outputs or experiment.cart == "clamped":
        return None
    position = experiment.outputs["cart_position"].values
    known = np.isfinite(position)
    time = experiment.sample_time * np.count_nonzero(known)
    if not is_held(spring, time):
        return None
    pushed = sum(float(np.mean(s.values)) for n, s in experiment.inputs.items() if n == "disturbance_force")
    balance = (coefficients["push"] * pushed - coefficients["offset"] + coefficients["against_offset"]) / spring
    off = float(np.mean(position[known])) - balance
    amplitude = float(np.sqrt(2) * np.std(position[known]))
    ends = 2 * float(np.max(np.abs(position[known] - np.mean(position[known])))) / np.sqrt(spring)
    speed = _fastest(experiment)
    allowed = (
        coefficients["dry"] / spring + (2 * coefficients["swing"] / spring * speed + ends) / time
        + coefficients["viscous"] / spring * abs(float(position[known][-1] - position[known][0])) / time
    )  # fmt: skip
    return off if abs(off) > _SLACK * allowed + ONE_SIDED * amplitude else None


def is_held(spring: float, time: float) -> bool:
    """Return whether a spring swings twice in a time, so that a mean tells where it rests; a slide has none.

    Args:
        spring: its stiffness over the mass [1/s^2].
        time: of the experiment [s].
    """
    return bool(time * np.sqrt(spring) >= 4 * np.pi)


def _fastest(experiment: Experiment) -> float:
    """Return the arm's largest speed [rad/s]."""
    if experiment.arm != "free":
        return 0.0
    if "arm_velocity" in experiment.outputs:
        return float(np.nanmax(np.abs(experiment.outputs["arm_velocity"].values)))
    if "arm_angle" in experiment.outputs:
        return float(np.nanmax(np.abs(np.gradient(experiment.outputs["arm_angle"].values, experiment.sample_time))))
    return 0.0
