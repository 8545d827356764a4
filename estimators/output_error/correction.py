"""The correction by which predictions lead a fit to the simulation: the gain of a filter with random forces of a given size."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from estimators.core.data import CHANNELS, Data
from estimators.core.parameter_space import Space, Unknowns
from estimators.prediction_error.filter_pass import run_filter
from estimators.prediction_error.noise_model import NoiseModel, start_variance
from rtac_jax import RTAC
from rtac_jax.parameters import Scales
from rtac_jax.programs.arrays import to_jax


def correction(
    data: Data,
    model: RTAC,
    space: Space,
    unknowns: Unknowns,
    noise: Float[np.ndarray, " output"],
    scales: Scales,
    fraction: float,
    substeps: int,
) -> tuple[Array, Array]:
    """Return the gain of a filter and the whitener of its innovations.

    Args:
        data: that it predicts.
        model: with the values of the unknowns or others.
        space: of the unknowns.
        unknowns: at which it predicts.
        noise: of the sensors, SI units.
        scales: typical sizes.
        fraction: random force and torque in one sample, as fractions of the rms ones.
        substeps: Runge-Kutta steps per sample.
    """
    # By the function that a diagnosis runs too, so that it is compiled once for both.
    interval = float(np.min(np.asarray(data.excitation.sample_time)))
    known = NoiseModel(noise, np.ones_like(noise), scales.force, scales.torque, interval, start_variance(space))
    size = np.concatenate([np.full(2, 2 * np.log(fraction)), np.zeros(len(CHANNELS))])
    result = run_filter(model, data, space, space.physical(unknowns), known, size, jnp.asarray(substeps))
    # One whitener for all samples: enough for a start, and the same compiled function as for the simulation.
    return result.gain, to_jax(_settled(np.asarray(result.whitener), data))


def _settled(whitener: np.ndarray, data: Data) -> Float[np.ndarray, "1 row output experiment"]:
    """Return the median whitener of each experiment and channel after its first quarter, over the samples that are there.

    Where a channel has no sample the filter's whitener is zero: counted, an experiment that is shorter than others, or a
    channel sampled less often, would tell nothing.
    """
    found = np.zeros((1, *whitener.shape[1:]))
    present = np.asarray(data.present) > 0
    for column in range(data.experiments):
        for row in range(whitener.shape[1]):
            there = np.flatnonzero(present[:, row, column])
            late = there[there >= (there[-1] + 1) // 4] if len(there) else there
            if len(late):
                found[0, row, :, column] = np.median(whitener[late, row, :, column], axis=0)
    return found
