"""The number of integration steps that a sample needs where the state is mended at every sample."""

import jax.numpy as jnp
import numpy as np

from estimators.core.data import Data
from estimators.core.parameter_space import Physical, Space
from estimators.core.step_size import MOST_SUBSTEPS, STEP_ERROR
from estimators.prediction_error.filter_pass import run_filter
from estimators.prediction_error.noise_estimation import first_noise, low_process_noise
from estimators.prediction_error.noise_model import NoiseModel
from rtac_jax import RTAC
from rtac_jax.simulation import substeps_for


def predictive_substeps(
    model: RTAC, data: Data, space: Space, physical: Physical, prior: NoiseModel, most: int = MOST_SUBSTEPS
) -> int:
    """Return the fewest Runge-Kutta steps per sample with which predictions one sample ahead are accurate enough.

    Halving them changes innovations by less than a fiftieth of their deviation, with so little random force that the filter
    forgets slowly. A free simulation needs more: of a model that is far from the data, of an arm that tumbles, or beside an encoder
    of a micrometre, its errors add up along the whole experiment.

    Args:
        model: that predicts.
        data: of all experiments.
        space: of its parameters and starts.
        physical: parameters and starts.
        prior: of the noise.
        most: steps, with which a free simulation is accurate enough.
    """
    noise = low_process_noise(first_noise())
    interval = np.asarray(data.excitation.sample_time)
    alike = [interval == one for one in np.unique(interval)]

    def run(substeps: int) -> np.ndarray:
        passed = run_filter(model, data, space, physical, prior, noise, jnp.asarray(substeps))
        return np.asarray(passed.innovations)[..., : len(interval)]

    substeps = substeps_for(model, data.excitation)
    coarse = run(substeps) if substeps < most else np.zeros(0)
    while substeps < most:
        fine = run(2 * substeps)
        # What does not count is zero, and which samples these are may differ.
        both = (coarse != 0) & (fine != 0)
        with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is seen below
            squares = np.where(both, (fine - coarse) ** 2, 0.0).sum(axis=0)
        count = both.sum(axis=0)
        change = np.sqrt([squares[:, c].sum(axis=1) / np.maximum(count[:, c].sum(axis=1), 1) for c in alike])
        if not np.all(np.isfinite(fine)) or np.all(change < STEP_ERROR):
            break
        substeps, coarse = 2 * substeps, fine
    return min(substeps, most)
