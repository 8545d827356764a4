"""Spectral line test: a vibration in the innovations that neither the input nor the state explains."""

import dataclasses
from collections.abc import Collection, Sequence

import numpy as np
from scipy.ndimage import median_filter
from scipy.special import gammainccinv
from scipy.stats import f as fisher

from estimators.core.data import CHANNELS
from estimators.misspecification.findings import SpectralLine
from rtac_jax.measurement import Experiment

_AROUND = 31  # lines whose median tells how strong the noise is there
# Their median scatters as a mean of so many independent powers by two, since a window ties neighbours together.
_FREEDOM = 20
_THERE = 0.5  # fraction of an experiment's samples that must count
_ALIKE = 0.9  # fraction of the longest's samples from which on experiments are cut to one length, and little is lost
# Bins that the noise in a line of a Hann window comes from, over the half of a spectrum.
_WINDOW = 3.0
_BLIND = 8  # lowest lines, where transients of the start end up


def spectral_line(
    innovations: np.ndarray, present: np.ndarray, experiments: Sequence[Experiment], rounded: Collection[str] = ()
) -> SpectralLine | None:
    """Return the strongest line over all experiments together; None where they are too short.

    The noise around it is measured on the same spectrum, so that smooth colour of the noise is no line.

    Args:
        innovations: [sample output experiment].
        present: 1 where measured.
        experiments: in the order of the innovations.
        rounded: channels that have next to no noise but rounding. That of a steady motion is a line itself, so one that has less
            power than all their noise is none.

    Source: Fisher, Proceedings of the Royal Society A 125 (1929), with a local estimate of the noise.
    """
    best: SpectralLine | None = None
    tried = 0
    for alike in _alike(experiments):
        interval = experiments[alike[0]].sample_time
        length = min(experiments[i].samples for i in alike)
        for output, channel in enumerate(CHANNELS):
            columns = [i for i in alike if present[:length, output, i].sum() > _THERE * length]
            if not columns or length < 8 * _AROUND:
                continue
            error = (innovations * present)[:length, output, columns]
            # A window keeps the line of one experiment from leaking; powers of experiments add up.
            window = np.hanning(length)[:, None]
            power = np.abs(np.fft.rfft(error * window, axis=0)) ** 2 / np.sum(window**2)
            power = (power / np.median(power[_BLIND:], axis=0)).mean(axis=1)[_BLIND:-1]
            n = len(columns)
            power = power / _trend(power)
            # The median of a mean of n exponentials lies below its mean by a known factor.
            middle = median_filter(power, _AROUND, mode="mirror") / (gammainccinv(n, 0.5) / n)
            ratio = power / middle
            peak = int(np.argmax(ratio))
            tried += len(ratio)
            if channel in rounded and _WINDOW * ratio[peak] < length:
                continue
            p_value = float(fisher.sf(ratio[peak], 2 * n, _FREEDOM * n))
            if best is None or p_value < best.p_value:
                frequency = 2 * np.pi * (peak + _BLIND) / (length * interval)
                best = SpectralLine(channel, frequency, float(ratio[peak]), 2 * n * float(ratio[peak] - 1), p_value)
    if best is None:
        return None
    return dataclasses.replace(best, p_value=min(1.0, best.p_value * tried))


def _alike(experiments: Sequence[Experiment]) -> list[list[int]]:
    """Return groups of experiments of one sample time and about one length, whose spectra have the same lines."""
    groups: list[list[int]] = []
    for column in sorted(range(len(experiments)), key=lambda i: -experiments[i].samples):
        own = experiments[column]
        for group in groups:
            longest = experiments[group[0]]
            if np.isclose(own.sample_time, longest.sample_time) and own.samples >= _ALIKE * longest.samples:
                group.append(column)
                break
        else:
            groups.append([column])
    return groups


def _trend(power: np.ndarray) -> np.ndarray:
    """Return the trend of coloured noise's power over frequency.

    At the ends of a spectrum no neighbours would tell it.
    """
    line = np.log(_BLIND + np.arange(len(power)))
    level = np.log(np.maximum(power, 1e-9 * np.median(power)))
    return np.exp(np.polynomial.Chebyshev.fit(line, level, 5)(line))
