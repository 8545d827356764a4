"""Step size: the number of integration steps that a sample needs."""

import numpy as np

from estimators.core.data import Data
from estimators.core.jacobian_factor import Arguments, plain_residual
from estimators.core.parameter_space import Space, Unknowns
from estimators.core.residual import diagonal_whitener, no_gain
from rtac_jax import RTAC
from rtac_jax.simulation import substeps_for

STEP_ERROR = 0.02
"""Change of the outputs by half as long steps, over the noise, from which on steps are too long."""
MOST_SUBSTEPS = 32


def accurate_substeps(model: RTAC, data: Data, space: Space, unknowns: Unknowns, noise: np.ndarray) -> int:
    """Return the fewest Runge-Kutta steps per sample that are accurate enough.

    Halving them changes outputs by less than a fiftieth of the noise.
    """
    white = diagonal_whitener(noise, data)
    nothing = no_gain(model, data)
    count = np.asarray(data.present).sum(axis=0)
    interval = np.asarray(data.excitation.sample_time)
    # Apart by sample time: in the mean over all, many short steps would hide that few long ones are too long.
    alike = [interval == one for one in np.unique(interval)]

    def run(substeps: int) -> np.ndarray:
        return np.asarray(plain_residual(unknowns, Arguments(model, data, space, white, nothing, substeps))[0])

    substeps = substeps_for(model, data.excitation)
    coarse = run(substeps)
    while substeps < MOST_SUBSTEPS:
        fine = run(2 * substeps)
        with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is seen below
            squares = ((fine - coarse) ** 2).sum(axis=0)
        change = np.sqrt([squares[:, c].sum(axis=1) / np.maximum(count[:, c].sum(axis=1), 1.0) for c in alike])
        if not np.all(np.isfinite(fine)) or np.all(change < STEP_ERROR):
            break
        substeps, coarse = 2 * substeps, fine
    return substeps
