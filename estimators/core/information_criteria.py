"""Akaike's and the Bayesian information criterion, and Akaike's final prediction error, of a fit."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rtac_jax.measurement import OUTPUTS


@dataclass(frozen=True)
class InformationCriteria:
    """The criteria by which a fit says how well its model will do on data that it has not seen; the smaller, the better.

    They compare fits to the same measurements. Of two models that are far apart in the order of a hundred the criteria say
    the same; near each other the Bayesian one takes the smaller model more readily.

    Attributes:
        log_likelihood: natural logarithm of the likelihood of all measurements, constants included.
        unknowns: number of everything that was estimated: shared parameters, those of each experiment, states at the start
            and levels of noise.
        samples: number of the measurements.
        rms: of the errors that the fit makes small, by channel, in the channel's unit: of simulations for output error, of
            predictions one sample ahead for prediction error.
    """

    log_likelihood: float
    unknowns: int
    samples: int
    rms: Mapping[str, float]

    @classmethod
    def of_rms(cls, rms: Mapping[str, float], counts: Mapping[str, int], unknowns: int) -> "InformationCriteria":
        """Return the criteria of errors that are taken as white and Gaussian, with a variance for each channel.

        Args:
            rms: of the errors by channel, which is the most likely standard deviation.
            counts: of the measurements by channel.
            unknowns: number of everything else that was estimated.

        Source: Ljung, System Identification (1999), equation (7.91), at the maximum over the variances.
        """
        total = sum(counts[channel] for channel in rms)
        value = -0.5 * sum(counts[c] * (np.log(2 * np.pi * max(s, 1e-300) ** 2) + 1) for c, s in rms.items())
        return cls(float(value), unknowns + len(rms), int(total), dict(rms))

    @property
    def aic(self) -> float:
        """Akaike's criterion, -2 log L + 2 d (Ljung 1999, section 16.4; Akaike 1974)."""
        return -2 * self.log_likelihood + 2 * self.unknowns

    @property
    def bic(self) -> float:
        """Return the Bayesian criterion, -2 log L + d log N (Schwarz 1978), Rissanen's description length times two."""
        return -2 * self.log_likelihood + float(np.log(self.samples)) * self.unknowns

    @property
    def fpe(self) -> dict[str, float]:
        """Akaike's final prediction error by channel, V (1 + d/N) / (1 - d/N) (Ljung 1999, equation (16.24)), unit squared.

        It estimates the mean square of the errors in fresh data.
        """
        fraction = self.unknowns / self.samples
        factor = (1 + fraction) / (1 - fraction) if fraction < 1 else float("inf")
        return {channel: factor * s**2 for channel, s in self.rms.items()}

    def __str__(self) -> str:
        squared = {channel: f"({unit})^2" if "/" in unit else f"{unit}^2" for channel, unit in OUTPUTS.items()}
        errors = ", ".join(f"{channel} {value:.4g} {squared[channel]}" for channel, value in self.fpe.items())
        return f"AIC {self.aic:.1f}, BIC {self.bic:.1f}, FPE {errors}"
