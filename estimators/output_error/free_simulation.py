"""The free simulation of a model beside the data: what a fit minimises, and how far it leaves the measurements."""

import dataclasses

import numpy as np
from jaxtyping import Float

from estimators.core.data import CHANNELS, Data, squares_of_motion
from estimators.core.fit import FAR
from estimators.core.jacobian_factor import Arguments, plain_residual
from estimators.core.parameter_space import Space, Unknowns
from estimators.core.residual import diagonal_whitener, no_gain
from rtac_jax import RTAC

Error = Float[np.ndarray, "sample output experiment"]


@dataclasses.dataclass(frozen=True)
class FreeSimulation:
    """The free simulation of a model, beside what was measured.

    Attributes:
        model: whose parameters are unknown.
        data: that it simulates.
        space: of the unknowns.
        noise: of the sensors, SI units.
        substeps: Runge-Kutta steps per sample.
    """

    model: RTAC
    data: Data
    space: Space
    noise: Float[np.ndarray, " output"]
    substeps: int = 1

    def arguments(self, deviation: Float[np.ndarray, " output"] | None = None) -> Arguments:
        """Return what its passes need, with channels weighted by these deviations; by the noise of the sensors where None."""
        whitener = diagonal_whitener(self.noise if deviation is None else deviation, self.data)
        return Arguments(self.model, self.data, self.space, whitener, no_gain(self.model, self.data), self.substeps)

    def error(self, unknowns: Unknowns) -> Error:
        """Return what it leaves of the measurements, SI units; zero where there is none."""
        return np.asarray(plain_residual(unknowns, self.arguments(np.ones(len(CHANNELS))))[0])

    def rms(self, error: Error) -> Float[np.ndarray, " output"]:
        """Return the rms of each channel's error, SI units; the noise where nothing was measured.

        A channel cannot be trusted beyond its sensor, or one that happens to fit would drown the others.
        """
        count = np.maximum(np.asarray(self.data.present).sum(axis=(0, 2)), 1.0)
        rms = np.sqrt((error**2).sum(axis=(0, 2)) / count)
        return np.where(rms > 0, np.maximum(rms, 1e-12 * self.noise), self.noise)

    def loses(self, unknowns: Unknowns, fraction: float) -> bool:
        """Return whether it leaves more than this fraction of a channel's motion in an experiment, beyond what noise explains."""
        left = (self.error(unknowns) ** 2).sum(axis=0)
        motion, count = squares_of_motion(self.data)
        follows = left <= np.maximum((FAR * self.noise[:, None]) ** 2 * count, fraction**2 * motion)
        return not np.all(follows)  # what is no number follows nothing
