"""A line in the spectrum of the innovations: a vibration that neither the input nor the state explains."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.ndimage import median_filter
from scipy.special import gammaincc, gammainccinv

from estimators._problem import CHANNELS
from rtac_jax.measurement import Experiment

_AROUND = 31  # lines whose median tells how strong the noise is there
_BLIND = 8  # lowest lines, where transients of the start end up


@dataclasses.dataclass(frozen=True)
class SpectralLine:
    """The strongest line.

    Attributes:
        channel: where it shows.
        frequency: of it [rad/s].
        ratio: power over that of the noise around.
        excess: of the line over the noise, in units of twice the log-likelihood.
        p_value: of so strong a line among all by chance.
    """

    channel: str
    frequency: float
    ratio: float
    excess: float
    p_value: float


def spectral_line(
    innovations: np.ndarray, present: np.ndarray, experiments: Sequence[Experiment]
) -> SpectralLine | None:
    """The strongest line over all experiments together; None where they are too short.

    The noise around it is measured on the same spectrum, so that smooth colour of the noise is no line.

    Args:
        innovations: [sample output experiment].
        present: 1 where measured.

    Source: Fisher, Proceedings of the Royal Society A 125 (1929), with a local estimate of the noise.
    """
    interval = float(np.median([e.sample_time for e in experiments]))
    alike = [i for i, e in enumerate(experiments) if np.isclose(e.sample_time, interval)]
    length = int(np.median([experiments[i].samples for i in alike]))
    best: SpectralLine | None = None
    tried = 0
    for output, channel in enumerate(CHANNELS):
        columns = [i for i in alike if present[:length, output, i].sum() > 0.9 * length]
        if not columns or length < 8 * _AROUND:
            continue
        error = (innovations * present)[:length, output, columns]
        # A window keeps the line of one experiment from leaking; powers of experiments add up.
        window = np.hanning(length)[:, None]
        power = np.abs(np.fft.rfft(error * window, axis=0)) ** 2 / np.sum(window**2)
        power = (power / np.median(power[_BLIND:], axis=0)).mean(axis=1)[_BLIND:-1]
        n = len(columns)
        # The median of a mean of n exponentials lies below its mean by a known factor.
        middle = median_filter(power, _AROUND, mode="nearest") / (gammainccinv(n, 0.5) / n)
        ratio = power / middle
        peak = int(np.argmax(ratio))
        tried += len(ratio)
        # The local median of 31 lines scatters; a tenth covers it.
        p_value = float(gammaincc(n, n * ratio[peak] / 1.1))
        if best is None or p_value < best.p_value:
            frequency = 2 * np.pi * (peak + _BLIND) / (length * interval)
            best = SpectralLine(channel, frequency, float(ratio[peak]), 2 * n * float(ratio[peak] - 1), p_value)
    if best is None:
        return None
    return dataclasses.replace(best, p_value=min(1.0, best.p_value * tried))
