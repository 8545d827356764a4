"""The arm's angle against its velocity: what two sensors agree on, no mistake in one of them undoes."""

import numpy as np

from rtac_jax.measurement import Experiment


def velocity_error(experiment: Experiment) -> float | None:
    """Return the mean squared difference of the measured velocity and the angle's changes, over that of the velocity.

    None where one of the two was not measured, or the velocity is zero throughout.
    """
    both = [experiment.outputs.get(channel) for channel in ("arm_angle", "arm_velocity")]
    if both[0] is None or both[1] is None:
        return None
    angle, velocity = both[0].values, both[1].values
    between = 0.5 * (velocity[1:] + velocity[:-1])
    error = np.diff(angle) / experiment.sample_time - between
    known = np.isfinite(error)
    power = float(np.mean(between[known] ** 2)) if known.any() else 0.0
    return float(np.mean(error[known] ** 2)) / power if power > 0 else None


def is_contradicted(before: Experiment, after: Experiment, most: float) -> bool:
    """Return whether angle and velocity agree as they were recorded, and no more with a mistake undone.

    Args:
        before: as recorded.
        after: with the mistake undone.
        most: fraction of the velocity's power by which they differ at most where they agree.
    """
    recorded, undone = velocity_error(before), velocity_error(after)
    return recorded is not None and undone is not None and recorded <= most < undone
