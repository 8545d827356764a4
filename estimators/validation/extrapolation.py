"""Detection of extrapolation: where a simulation asks a learned force for values beyond its range."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from rtac_jax import RTAC
from rtac_jax.effects import SplineForce
from rtac_jax.measurement import Experiment

_WORTH = 0.05  # fraction of the samples that is worth a word: ranges leave out the outermost of what was recorded


def beyond(
    model: RTAC, experiment: Experiment, simulated: Mapping[str, Float[np.ndarray, " sample"]]
) -> tuple[str, float] | None:
    """Return the variable of a learned force and the fraction of samples at which it lies beyond the force's range.

    None where it seldom does, where the model has no such force, or where no channel shows the variable.

    Args:
        model: with or without a learned force.
        experiment: that was simulated.
        simulated: of each channel, SI units; NaN where nothing was measured.
    """
    for effect in model.effects:
        if not isinstance(effect, SplineForce):
            continue
        variable = effect.depends_on.split(",")[0]
        values = _values(variable, experiment, simulated)
        known = values[np.isfinite(values)]
        low, high = effect.between
        fraction = float(np.mean((known < low) | (known > high))) if known.size else 0.0
        if fraction >= _WORTH:
            return variable, fraction
    return None


def _values(
    variable: str, experiment: Experiment, simulated: Mapping[str, Float[np.ndarray, " sample"]]
) -> Float[np.ndarray, " value"]:
    """Return the values of a variable in a simulation; empty where no channel shows it."""
    nothing = np.zeros(0)
    if variable == "cart_velocity":
        position = simulated.get("cart_position", nothing)
        return np.gradient(position, experiment.sample_time) if len(position) else nothing
    if variable == "arm_angle":
        angle = simulated.get("arm_angle", nothing)
        return np.arctan2(np.sin(angle), np.cos(angle))
    if variable == "current":
        return np.asarray(experiment.inputs["current"].values) if "current" in experiment.inputs else nothing
    return simulated.get(variable, nothing)
