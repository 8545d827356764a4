"""Step size: the number of integration steps that a sample needs."""

import numpy as np

from estimators.core.data import Data
from estimators.core.levenberg_marquardt import Arguments, plain_residual
from estimators.core.parameter_space import Space, Unknowns
from estimators.core.residual import diagonal_whitener, no_gain
from rtac_jax import RTAC
from rtac_jax.simulation import substeps_for

_STEP_ERROR = 0.02
_MOST_SUBSTEPS = 32


def accurate_substeps(model: RTAC, data: Data, space: Space, unknowns: Unknowns, noise: np.ndarray) -> int:
    """Return the fewest Runge-Kutta steps per sample that are accurate enough.

    Halving them changes outputs by less than a fiftieth of the noise.
    """
    white = diagonal_whitener(noise, data)
    nothing = no_gain(model, data)
    count = np.maximum(np.asarray(data.present).sum(axis=(0, 2)), 1.0)

    def run(substeps: int) -> np.ndarray:
        return np.asarray(plain_residual(unknowns, Arguments(model, data, space, white, nothing, substeps))[0])

    substeps = substeps_for(model, data.excitation)
    coarse = run(substeps)
    while substeps < _MOST_SUBSTEPS:
        fine = run(2 * substeps)
        change = np.sqrt(((fine - coarse) ** 2).sum(axis=(0, 2)) / count)
        if not np.all(np.isfinite(fine)) or np.all(change < _STEP_ERROR):
            break
        substeps, coarse = 2 * substeps, fine
    return substeps
