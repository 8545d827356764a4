"""Maps of the innovations' size: by experiment, time, frequency and state."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.stats import chi2

from estimators.core.data import CHANNELS
from rtac_jax.measurement import Experiment

_PARTS = 4


@dataclasses.dataclass(frozen=True)
class Place:
    """The mean squared innovation in one part of the data; one where the model is right.

    Attributes:
        by: "experiment", "time", "frequency" or a channel whose size sorted the samples.
        label: which part.
        channel: whose innovations.
        value: their mean square.
        high: bound that chance exceeds in one of a hundred.
        part: number of the part among those of its kind.
    """

    by: str
    label: str
    channel: str
    value: float
    high: float
    part: int = 0

    @property
    def excess(self) -> float:
        """Return the mean square over its bound."""
        return self.value / self.high


def where(innovations: np.ndarray, present: np.ndarray, experiments: Sequence[Experiment]) -> list[Place]:
    """Return mean squared innovations by part of the data, worst first.

    Args:
        innovations: [sample output experiment].
        present: 1 where measured.
        experiments: in the order of the innovations.
    """
    found = []
    squares = np.where(present > 0, innovations**2, 0.0)

    def add(by: str, part: int, label: str, channel: str, total: float, measured: float | np.integer) -> None:
        count = float(measured)
        if count > 8:
            found.append(Place(by, label, channel, float(total) / count, float(chi2.ppf(0.99, count)) / count, part))

    for row, channel in enumerate(CHANNELS):
        own, there = squares[:, row], present[:, row]
        if not there.any():
            continue
        for column, e in enumerate(experiments):
            add("experiment", column, e.name, channel, own[:, column].sum(), there[:, column].sum())
        lengths = there.sum(axis=0)
        order = np.cumsum(there, axis=0) / np.maximum(lengths, 1)
        for part in range(_PARTS):
            inside = (order > part / _PARTS) & (order <= (part + 1) / _PARTS) & (there > 0)
            add("time", part, f"quarter {part + 1} of each experiment", channel, own[inside].sum(), inside.sum())
        found += _by_frequency(innovations[:, row] * (there > 0), there, experiments, channel)
        for other in CHANNELS:
            sizes = np.full(own.shape, np.nan)
            for column, e in enumerate(experiments):
                if other in e.outputs:
                    sizes[: e.samples, column] = np.abs(e.outputs[other].values)
            seen = np.isfinite(sizes) & (there > 0)
            if other == "arm_angle" or not seen.any():
                continue
            edges = np.quantile(sizes[seen], np.linspace(0, 1, _PARTS + 1))
            for part in range(_PARTS):
                inside = seen & (sizes >= edges[part]) & (sizes < edges[part + 1])
                label = f"|{other}| {edges[part]:.2g} to {edges[part + 1]:.2g}"
                add(other, part, label, channel, own[inside].sum(), inside.sum())
    return sorted(found, key=lambda place: -place.excess)


def _by_frequency(
    errors: np.ndarray, there: np.ndarray, experiments: Sequence[Experiment], channel: str
) -> list[Place]:
    totals, counts = np.zeros(_PARTS), np.zeros(_PARTS)
    fastest = max(np.pi / e.sample_time for e in experiments)
    edges = fastest * np.array([0.0, 1 / 27, 1 / 9, 1 / 3, 1.0])
    for column, e in enumerate(experiments):
        n = int(there[:, column].sum())
        if n < 16:
            continue
        power = np.abs(np.fft.rfft(errors[: e.samples, column])) ** 2 / n
        frequency = 2 * np.pi * np.fft.rfftfreq(e.samples, e.sample_time)
        part = np.clip(np.searchsorted(edges, frequency, side="right") - 1, 0, _PARTS - 1)
        totals += np.bincount(part, weights=2 * power, minlength=_PARTS)
        counts += np.bincount(part, weights=np.full(len(part), 2.0), minlength=_PARTS)
    return [
        Place(
            "frequency", f"{_plain(edges[i])} to {_plain(edges[i + 1])} rad/s", channel, float(totals[i] / counts[i]),
            float(chi2.ppf(0.99, counts[i])) / counts[i], i,
        )
        for i in range(_PARTS) if counts[i] > 8
    ]  # fmt: skip


def _plain(value: float) -> str:
    """Return a number in three figures, and in no power of ten up to a million."""
    return f"{float(f'{value:.3g}'):g}"
