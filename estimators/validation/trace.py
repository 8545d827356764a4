"""One channel of one experiment beside its simulation or prediction, and what its residual says."""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float

from estimators.core.correlation import LAGS, LEVEL, CrossCorrelation, Whiteness, centred, cross_correlation, whiteness

Values = Float[np.ndarray, " sample"]


def colour_of(p_value: float | None) -> str:
    """Return what the p-value of a test of whiteness says; without one, that nothing was tested."""
    if p_value is None or np.isnan(p_value):
        return "not tested"
    return "white" if p_value > LEVEL else "not white"


@dataclasses.dataclass(frozen=True)
class Trace:
    """The measurement of one channel of one experiment beside its simulation.

    Attributes:
        experiment, channel: names.
        time: [s].
        measured, simulated: SI units; NaN where nothing was measured.
        current: motor current or, without one, the disturbance force, for the cross-correlation.
        used: whether a sample counts in the error (those that only set the start do not).
        noise: standard deviation of the sensor's noise.
    """

    experiment: str
    channel: str
    time: Values
    measured: Values
    simulated: Values
    current: Values
    used: Any
    noise: float

    @property
    def residual(self) -> Values:
        """Measured less simulated, NaN where it does not count."""
        return np.where(self.used, self.measured - self.simulated, np.nan)

    @property
    def rms(self) -> float:
        """Root mean square of the residual, SI units."""
        return float(np.sqrt(np.nanmean(self.residual**2)))

    @property
    def fit_percent(self) -> float:
        """100 (1 - |y - yhat| / |y - mean y|); minus infinity for a constant output."""
        spread = np.sqrt(np.nanmean(self.deviation**2))
        return float(100 * (1 - self.rms / spread)) if spread > 0 else float("-inf")

    @property
    def deviation(self) -> Values:
        """Return what was measured less its mean, over the samples that count; NaN elsewhere."""
        measured = np.where(self.used, self.measured, np.nan)
        return measured - np.nanmean(measured)

    def autocorrelation(self, lags: int = 50) -> tuple[Float[np.ndarray, " lag"], float]:
        """Return the residual's autocorrelation at lags 0 to `lags`, and the 99 % band for white noise."""
        found = self._whiteness(min(lags, len(self.time) - 1))
        return np.append(1.0, found.autocorrelation), found.band

    def cross_correlation(self, lags: int = 50) -> tuple[Float[np.ndarray, " lag"], float]:
        """Return the correlation of the residual with the input 0 to `lags` samples before, and its 99 % band.

        The band is that of independence, whatever the colours of both.

        Source: Bartlett, J. R. Statist. Soc. Suppl. 8 (1946); Ljung, System Identification (1999), section 16.6.
        """
        found = self.input_correlation(lags)
        return found.values[found.lags >= 0], found.band

    def input_correlation(self, lags: int = 50) -> CrossCorrelation:
        """Return the correlation of the residual with the input at lags -`lags` to `lags`, with its 99 % band.

        At negative lags the input follows the residual, as feedback makes it.
        """
        return cross_correlation(self.residual, self.current, lags)

    @property
    def whiteness_p(self) -> float:
        """Probability that white noise is at least as correlated over 25 lags (Ljung and Box, Biometrika 65, 1978).

        NaN where fewer than four samples count, which tell nothing.
        """
        lags = int(min(LAGS, np.sum(np.isfinite(self.residual)) // 4))
        return float("nan") if lags < 1 else self._whiteness(lags).p_value

    @property
    def colour(self) -> str:
        """Return whether the residual is "white" at 1 %, "not white", or "not tested"."""
        return colour_of(self.whiteness_p)

    def _whiteness(self, lags: int) -> Whiteness:
        return whiteness(centred(self.residual), np.isfinite(self.residual).astype(float), lags)
