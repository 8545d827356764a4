"""The noise of channels as what a residual leaves of them: the likelihood with the noise at its best values."""

import dataclasses

import numpy as np
from jaxtyping import Float

from estimators.core.data import Data

# A channel cannot be trusted beyond its sensor by more than this, or one that happens to fit would drown the others.
_LEAST = 1e-12


@dataclasses.dataclass(frozen=True)
class ConcentratedNoise:
    """The noise of each channel at its likeliest value, by the sum of squares of its residual.

    Attributes:
        counts: samples of each channel.

    Source: Ljung, System Identification (1999), section 7.2, on the likelihood with the noise concentrated out.
    """

    counts: Float[np.ndarray, " output"]

    @classmethod
    def of(cls, data: Data) -> "ConcentratedNoise":
        """Return that of the samples that were measured."""
        return cls(np.asarray(data.present).sum(axis=(0, 2)))

    def deviations(self, squares: Float[np.ndarray, " output"]) -> Float[np.ndarray, " output"]:
        """Return the deviation of each channel; one where nothing is left, or nothing was measured."""
        found = np.sqrt(squares / np.maximum(self.counts, 1.0))
        return np.where(found > 0, np.maximum(found, _LEAST), 1.0)

    def cost(self, squares: Float[np.ndarray, " output"]) -> float:
        """Return the negative log-likelihood, less a constant."""
        return float(np.sum(self.counts * np.log(self.deviations(squares))))
