"""Innovations under a periodic input, sorted by spectral line: linear dynamics, odd and even nonlinearity, noise."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.stats import f as fisher

from estimators.core.data import CHANNELS
from rtac_jax.measurement import Experiment

_CLASSES = ("excited", "odd", "even")
_SHOWS = {
    "excited": "linear dynamics",
    "odd": "an odd nonlinearity (dry friction, dead zone, cubic)",
    "even": "an even one (tilt, asymmetry, offset)",
}


@dataclasses.dataclass(frozen=True)
class LineClass:
    """The power of the innovations on one class of lines of a periodic input.

    Attributes:
        lines: "excited", "odd" or "even"; the last two are harmonics that the input leaves out.
        channel: whose innovations.
        ratio: mean power there over that between the harmonics, where there is only noise.
        p_value: of so large a ratio by chance.
    """

    lines: str
    channel: str
    ratio: float
    p_value: float

    @property
    def shows(self) -> str:
        """Return the kind of model error that a large ratio shows."""
        return _SHOWS[self.lines]


def line_classes(innovations: np.ndarray, present: np.ndarray, experiments: Sequence[Experiment]) -> list[LineClass]:
    """Return ratios for each class and channel; empty unless an experiment repeats its input at least twice.

    Args:
        innovations: [sample output experiment].
        present: 1 where measured.
        experiments: in the order of the innovations.

    Source: Schoukens, Vaes and Pintelon, IEEE Control Systems Magazine 36 (2016).
    """
    sums = {(c, k): np.zeros(2) for c in CHANNELS for k in (*_CLASSES, "noise")}
    for column, e in enumerate(experiments):
        drive = next((s.values for s in e.inputs.values() if np.any(s.values)), None)
        length = None if drive is None else period(drive)
        if drive is None or length is None:
            continue
        periods = len(drive) // length
        lines = np.abs(np.fft.rfft(drive[:length]))
        excited = lines > 1e-3 * np.max(lines)
        highest = 3 * int(np.max(np.nonzero(excited)[0]))
        for row, channel in enumerate(CHANNELS):
            count = periods * length
            if not present[:count, row, column].all():
                continue
            power = np.abs(np.fft.rfft(innovations[:count, row, column])) ** 2 / count
            for line in range(1, min(highest * periods + 1, len(power))):
                harmonic, between = divmod(line, periods)
                name = "noise" if between else "excited" if excited[harmonic] else ("even", "odd")[harmonic % 2]
                sums[channel, name] += (power[line], 2.0)
    found = []
    for channel in CHANNELS:
        noise = sums[channel, "noise"]
        for name in _CLASSES:
            power = sums[channel, name]
            if noise[1] and power[1] and noise[0] > 0:
                ratio = (power[0] / power[1]) / (noise[0] / noise[1])
                found.append(LineClass(name, channel, float(ratio), float(fisher.sf(ratio, power[1], noise[1]))))
    return found


def period(values: np.ndarray) -> int | None:
    """Return the samples after which a signal repeats itself exactly, at least twice; None where it does not."""
    size = float(np.max(np.abs(values), initial=0.0))
    if size == 0.0:
        return None
    for length in range(8, len(values) // 2 + 1):
        if abs(values[length] - values[0]) > 1e-9 * size:
            continue
        if np.max(np.abs(values[length:] - values[:-length])) <= 1e-9 * size:
            return None if np.ptp(values[:length]) == 0 else length
    return None
