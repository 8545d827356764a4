"""Reconstruction of the arm's angle over an experiment, from whatever tells it."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float64
from scipy.integrate import cumulative_trapezoid

from rtac_jax import RTAC, simulate
from rtac_jax.measurement import Recording


def arm_angles(
    recording: Recording,
    names: Sequence[str],
    given: Mapping[str, Float64[np.ndarray, " sample"]] | None = None,
    model: RTAC | None = None,
) -> dict[str, Float64[np.ndarray, " sample"]]:
    """Return theta(t) [rad] of the named experiments: given, else measured, else of a model, else integrated.

    Integration starts from `initial_arm_angle`. A tachometer's bias would turn the integral away by a radian in ten
    seconds, so its mean over the experiments at rest is taken off first; without any at rest it is taken as it is, and a
    model is the better source.

    Raises:
        ValueError: an angle given has the wrong length, one that is measured has gaps, or nothing tells the angle.
    """
    rests = [e.outputs["arm_velocity"].values for e in recording if e.kind == "rest" and "arm_velocity" in e.outputs]
    bias = float(np.nanmean(np.concatenate(rests))) if rests else 0.0
    found = {}
    simulated: list[str] = []
    for name in names:
        experiment = recording[name]
        place = f"/experiments/{name}"
        if given is not None and name in given:
            theta = np.asarray(given[name], dtype=np.float64)
            if theta.shape != (experiment.samples,):
                raise ValueError(
                    f"angles: {name} has shape {theta.shape}, but the experiment has {experiment.samples} samples."
                )
        elif "arm_angle" in experiment.outputs:
            theta = experiment.outputs["arm_angle"].values
        elif model is not None:
            simulated.append(name)
            continue
        elif "arm_velocity" in experiment.outputs and experiment.initial_arm_angle is not None:
            speed = experiment.outputs["arm_velocity"].values - bias
            theta = experiment.initial_arm_angle + cumulative_trapezoid(speed, dx=experiment.sample_time, initial=0.0)
        else:
            raise ValueError(
                f"{place}: nothing tells the arm's angle; record arm_angle, or arm_velocity with initial_arm_angle, give "
                "angles or a model, or set compensate=False."
            )
        if np.any(np.isnan(theta)):
            raise ValueError(
                f"{place}: the arm's angle has missing samples; fill them and give angles, or give a model."
            )
        found[name] = theta
    if simulated and model is not None:
        motion = simulate(model, [recording[name] for name in simulated])
        found |= {name: motion[name].arm_angle for name in simulated}
    return found
