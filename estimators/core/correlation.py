"""Correlations of a residual with itself and with an input, with confidence bounds, and Ljung and Box's test."""

from dataclasses import dataclass

import numpy as np
import scipy.fft
from jaxtyping import Float
from scipy.signal.windows import parzen
from scipy.stats import chi2, norm

Values = Float[np.ndarray, " sample"]

LEVEL = 0.01  # of every band and test of correlations here: bands hold 99 %, as Ljung's section 16.6 draws them
LAGS = 25  # lags of the whiteness test, as Ljung's section 16.6 and MATLAB's resid take


def require_level(level: float) -> None:
    """Refuse what is no level of a test.

    Raises:
        ValueError: it is not between 0 and 1.
    """
    if not 0 < level < 1:
        raise ValueError(f"level is {level:g}; give the level of a test, between 0 and 1, as 0.01.")


def quantile() -> float:
    """Return the half-width of the band of a standard normal variable."""
    return float(norm.isf(LEVEL / 2))


def autocovariance(values: Values, lags: int) -> Float[np.ndarray, " lag"]:
    """Return the sum of products at lags 0 ... `lags`, over the number of values."""
    length = scipy.fft.next_fast_len(len(values) + lags, real=True)
    spectrum = np.fft.rfft(values, length)
    return np.fft.irfft(np.abs(spectrum) ** 2, length)[: lags + 1] / len(values)


@dataclass(frozen=True, eq=False)
class Whiteness:
    """The autocorrelation of a residual and the test of whether it is white.

    Attributes:
        autocorrelation: at lags 1, 2, ... samples [1].
        band: 99 % of each of them lie within plus and minus this if the residual is white.
        p_value: probability of autocorrelations as large by chance, all lags together; NaN where no two samples are as far
            apart as any of the lags.
    """

    autocorrelation: Float[np.ndarray, " lag"]
    band: float
    p_value: float


def whiteness(error: Values, present: Values, lags: int = LAGS, *, fitted: int = 0) -> Whiteness:
    """Compute the autocorrelation of a residual, and Ljung and Box's test of whether it is white.

    The test takes a channel that is read every nth sample at its own rate: its lags are n, 2 n, ... samples.

    Args:
        error: zero where there is none.
        present: 1 where a sample counts, else 0.
        lags: largest lag [samples that count].
        fitted: number of parameters of a noise model that were fitted to make it white, which cost degrees of freedom.

    Source: Ljung and Box, Biometrika 65 (1978); Ljung, System Identification (1999), section 16.6.
    """
    count = float(np.sum(present))
    places = np.flatnonzero(present)
    rate = int(np.gcd.reduce(np.diff(places))) if len(places) > 1 else 1
    at_rate = slice(places[0] if len(places) else 0, None, rate)
    error_at_rate, present_at_rate = error[at_rate], present[at_rate]
    # Where samples are missing, fewer tell of a lag.
    pairs = autocovariance(present_at_rate, lags)[1:] * len(present_at_rate)
    told = pairs > 0.5  # whole numbers but for rounding
    statistic = count * (count + 2) * float(np.sum(_autocorrelation(error_at_rate, lags)[1:][told] ** 2 / pairs[told]))
    p_value = float(chi2.sf(statistic, max(int(np.sum(told)) - fitted, 1))) if told.any() else float("nan")
    return Whiteness(_autocorrelation(error, lags)[1:], quantile() / np.sqrt(max(count, 1.0)), p_value)


@dataclass(frozen=True, eq=False)
class CrossCorrelation:
    """The correlation of a residual with an input at both signs of lag.

    At positive lags the residual follows the input: the model lacks some of its response. At negative lags the input follows
    the residual: feedback, which says nothing against the model.

    Attributes:
        lags: by which the residual is later than the input [samples].
        values: at these lags [1].
        band: 99 % of each of them lie within plus and minus this if the two are independent, whatever their colours.
    """

    lags: Float[np.ndarray, " lag"]
    values: Float[np.ndarray, " lag"]
    band: float

    @property
    def outside(self) -> int:
        """Return the number of lags at which the residual follows the input by more than the band."""
        return int(np.sum((np.abs(self.values) > self.band) & (self.lags >= 0)))


def cross_correlation(error: Values, signal: Values, lags: int = LAGS) -> CrossCorrelation:
    """Compute the correlation of a residual with an input at lags -`lags` ... `lags`.

    Args:
        error: the residual, NaN where there is none.
        signal: the input, as long.
        lags: largest lag [samples].

    Source: Bartlett, J. R. Statist. Soc. Suppl. 8 (1946); Ljung, System Identification (1999), section 16.6.
    """
    x, z = centred(error), centred(signal)
    lags = min(lags, len(x) - 1)
    length = scipy.fft.next_fast_len(len(x) + lags, real=True)
    product = np.fft.irfft(np.fft.rfft(x, length) * np.conj(np.fft.rfft(z, length)), length)
    size = np.sqrt(np.sum(x**2) * np.sum(z**2))
    both = np.concatenate([product[len(product) - lags :], product[: lags + 1]])
    return CrossCorrelation(
        np.arange(-lags, lags + 1.0), both / size if size > 0 else 0.0 * both, independence_band(x, z)
    )


def independence_band(a: Values, b: Values) -> float:
    """Return the 99 % band of the cross-correlation of independent signals without a mean.

    Its variance is sum_k R_a(k) R_b(k) / N.
    """
    own = _autocorrelation(a, len(a) - 1) * _autocorrelation(b, len(b) - 1)
    # Over all lags the sum would be the mean square of the correlations themselves, and nothing could stand out of it;
    # and Parzen's window keeps it positive, which a cut would not.
    longest = max(len(own) // 3, 1)
    weight = parzen(2 * longest - 1)[longest - 1 :]
    inflation = own[0] + 2 * float(np.sum((weight * own[:longest])[1:]))
    return quantile() * float(np.sqrt(inflation / len(own)))


def _autocorrelation(x: Values, lags: int) -> Float[np.ndarray, " lag"]:
    """Return the autocorrelation at lags 0 ... `lags`; one at lag zero also where there is no signal."""
    found = autocovariance(x, lags)
    return found / found[0] if found[0] > 0 else np.eye(1, len(found))[0]


def centred(values: Values) -> Values:
    """Return the signal without its mean, and zero where nothing was measured."""
    return (
        np.nan_to_num(values - np.nanmean(values)) if np.isfinite(values).any() else np.zeros(len(values), dtype=float)
    )
