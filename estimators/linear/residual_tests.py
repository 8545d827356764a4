"""Tests of whether prediction errors are white and independent of the input, with 99 % bands and what a failure means."""

from dataclasses import dataclass

import numpy as np
import scipy.signal
import scipy.stats
from jaxtyping import Float, Int

from estimators.core.correlation import LEVEL, autocovariance, quantile, whiteness
from estimators.linear.initialisation import autoregression

Colour = tuple[Float[np.ndarray, " order"], float]
"""The autoregression that whitens errors, leading one included, and the variance that it leaves."""

_DETERMINED = 1e-7  # singular value of the scaled Jacobian, below which a combination of parameters was not fitted
_LONGEST = 20  # order of the autoregression that stands for the colour of the errors
_FED_BACK = 1e-4  # probability of an input that seems to follow the errors by chance, below which it is said


@dataclass(frozen=True, eq=False)
class ResidualTest:
    """The correlations of a condition's prediction errors.

    Attributes:
        autocorrelation: at lags 1, 2, ... samples [1].
        white_band: 99 % of each of them lie within plus and minus this if the errors are white.
        cross_correlation: with the input, at lags 0, 1, 2, ... samples [1].
        cross_band: the same if the errors are independent of the input, whatever their colour; one for each lag.
        white_p: probability of autocorrelations as large by chance, all lags together.
        cross_p: the same for the cross-correlations; without lag 0 where an input that is held cannot show in the same sample.
        feedback_correlation: with the input 1, 2, ... samples later [1], at negative lags: where the input follows the errors,
            as in a closed loop. No test of the model counts it.
        feedback_band: of those.
        feedback_p: probability of correlations as large by chance where the input does not follow the errors; of the negative
            lags, and of lag 0 where the test of the model leaves that out.
    """

    autocorrelation: Float[np.ndarray, " lag"]
    white_band: float
    cross_correlation: Float[np.ndarray, " from_zero"]
    cross_band: Float[np.ndarray, " from_zero"]
    white_p: float
    cross_p: float
    feedback_correlation: Float[np.ndarray, " lag"]
    feedback_band: Float[np.ndarray, " lag"]
    feedback_p: float = 1.0

    @property
    def white(self) -> bool:
        """Return whether whiteness stands at 1 %."""
        return self.white_p >= LEVEL

    @property
    def independent(self) -> bool:
        """Return whether independence of the input stands at 1 %."""
        return self.cross_p >= LEVEL

    @property
    def fed_back(self) -> bool:
        """Return whether the input follows the errors, as a controller in the loop makes it."""
        return self.feedback_p < _FED_BACK

    def verdict(self, noise_modelled: bool) -> str:
        """Return the outcome in words, with what to do."""
        said = self._of_model(noise_modelled)
        if not self.fed_back:
            return said
        needs = (
            "which a right model of the noise allows"
            if noise_modelled
            else "which needs a model of the noise (box_jenkins)"
        )
        return f"{said}; the input follows the errors, as with a controller in the loop, {needs}; frequency_responses are off there"

    def _of_model(self, noise_modelled: bool) -> str:
        if not self.independent:
            return (
                "the errors still hold a response to the input, so G lacks dynamics or the plant is not linear: raise modes, or "
                "compare smaller amplitudes"
            )
        if self.white:
            return "the errors are white and independent of the input"
        if noise_modelled:
            return "the errors are independent of the input, but coloured: raise noise_order; G may stand"
        return "the errors are independent of the input, but coloured, which output error allows; its standard deviations count it"


def residual_test(
    error: Float[np.ndarray, " sample"],
    signal: Float[np.ndarray, " sample"],
    present: Float[np.ndarray, " sample"],
    jacobian: Float[np.ndarray, "sample parameter"],
    colour: Colour,
    *,
    noise_parameters: int,
    lags: int = 25,
    first: int = 0,
) -> ResidualTest:
    """Compute Ljung and Box's test of whiteness, and a quadratic form in the cross-correlations.

    What the fit took out of the errors, which were e before it, is J (J'J)^-1 J'e: the cross-correlations count what is
    left of the shifted inputs when their part in J is taken out too. With coloured errors and output error, that
    matters.

    Args:
        error: zero where the output is not present.
        signal: the input.
        present: 1 where the output was measured, else 0.
        jacobian: J, of the errors by what was fitted.
        colour: of the error, by `whitened`.
        noise_parameters: of H, which cost degrees of freedom.
        lags: largest lag [samples].
        first: least lag at which the model's output answers the input: 1 where that is held and G has no feedthrough. What
            shows before can only be feedback.

    Source: Ljung, System Identification (1999), section 16.6; Ljung and Box, Biometrika 65 (1978).
    """
    count = float(np.sum(present))
    lags = int(min(lags, len(error) // 4))
    own = whiteness(error, present, lags, fitted=noise_parameters)
    length = len(signal)
    after = [np.append(np.zeros(k), signal[: length - k]) for k in range(lags + 1)]
    before = [np.append(signal[k:], np.zeros(k)) for k in range(1, lags + 1)]
    shifted = np.stack([*after, *before], axis=1) * present[:, None]
    cross = shifted.T @ error
    span, strength, _ = np.linalg.svd(
        jacobian / np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300), full_matrices=False
    )
    span = span[:, strength > _DETERMINED]
    # The variance of sum e(t) u(t - k) is that of white noise against u filtered backwards by the errors' colour.
    whitening, innovation = colour
    coloured = backward_coloured(shifted - span @ (span.T @ shifted), whitening)
    # The variance was taken over all samples, of which those that are missing have no error.
    variance = innovation * len(error) / max(count - span.shape[1], 1.0) * coloured.T @ coloured
    size = np.sqrt(np.sum(error**2) * np.sum(signal**2))
    forward = np.arange(first, lags + 1)
    cross_p = _chance(cross, variance, forward)
    feedback_p = _chance(cross, variance, np.setdiff1d(np.arange(2 * lags + 1), forward))
    cross, band = cross / size, quantile() * np.sqrt(np.diagonal(variance)) / size
    return ResidualTest(
        own.autocorrelation,
        own.band,
        cross[: lags + 1],
        band[: lags + 1],
        own.p_value,
        cross_p,
        cross[lags + 1 :],
        band[lags + 1 :],
        feedback_p,
    )


def _chance(
    cross: Float[np.ndarray, " lag"], variance: Float[np.ndarray, "lag lag"], which: Int[np.ndarray, " some"]
) -> float:
    """Return the probability of correlations as large as these by chance, all together."""
    values, vectors = np.linalg.eigh(variance[np.ix_(which, which)])
    kept = values > 1e-6 * values[-1]
    parts = (vectors[:, kept].T @ cross[which]) ** 2 / values[kept]
    return float(scipy.stats.chi2.sf(np.sum(parts), int(np.sum(kept))))


def whitened(error: Float[np.ndarray, " sample"]) -> Colour:
    """Return the autoregression that whitens the errors, leading one included, and the variance left.

    Its order is the one of least AIC among 0, 1, 2, 4, 8 and the longest.
    """
    count = len(error)
    covariance = autocovariance(error, min(_LONGEST, count // 10))
    best, least = (np.ones(1), float(covariance[0])), np.inf
    for order in (0, 1, 2, 4, 8, _LONGEST):
        if order >= len(covariance):
            break
        whitening = np.append(1.0, autoregression(covariance, order) if order else [])
        variance = float(whitening @ covariance[: order + 1])
        score = count * np.log(max(variance, 1e-300)) + 2 * order
        if score < least:
            best, least = (whitening, variance), score
    return best


def backward_coloured(
    columns: Float[np.ndarray, "sample *column"], whitening: Float[np.ndarray, " order"]
) -> Float[np.ndarray, "sample *column"]:
    """Apply the transpose of the colouring filter 1 / whitening: backwards in time."""
    return np.asarray(scipy.signal.lfilter([1.0], whitening, columns[::-1], axis=0))[::-1]
