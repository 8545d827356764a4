"""Hum of the mains in measured signals: found by its line in the spectrum, and subtracted."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.signal
import scipy.stats
from jaxtyping import Float64

from ._experiment import Experiment
from ._filter import filled

Values = Float64[np.ndarray, " sample"]

MAINS = (50.0, 60.0, 100.0, 120.0)  # and twice each, as rectifiers give it [Hz]
_WITHIN = 0.004  # of the frequency: grids keep within 1 % for 99.5 % of a year by EN 50160, and large ones within half of this
_LONGEST = 10.0  # s over which the frequency of a grid holds to a fraction of a turn
_BELOW_NYQUIST = 0.9  # of half the sampling rate, beyond which a sine is told from its mirror image no more
_BESIDE = 30  # lines whose mean on both sides is the power without hum
_APART = 3  # lines over which a Hann window spreads a sine, on each side
_FEWEST = 8 * _BESIDE  # samples
_CHANCE = 1e-6  # of hum where there is none, for one channel and frequency
_FINE = 8  # frequencies tried per line of the spectrum


@dataclass(frozen=True)
class Hum:
    """A sine of the mains in one output.

    Attributes:
        channel: the output.
        unit: of it.
        frequency: of the mains, or twice that [Hz].
        amplitude: root mean square of the amplitudes of all experiments, in the unit of the channel.
    """

    channel: str
    unit: str
    frequency: float
    amplitude: float

    def __str__(self) -> str:
        return f"{self.channel} {self.amplitude:.2g} {self.unit} at {self.frequency:.4g} Hz"


def hum_subtracted(hum: Sequence[Hum]) -> str:
    """Return what was subtracted, in words; nothing where there was none."""
    return f"Hum of the mains was subtracted first: {' and '.join(map(str, hum))}." if hum else ""


class _Line(NamedTuple):
    part: slice
    ratio: float
    others: float
    frequency: float
    amplitude: complex


def without_hum(experiments: Sequence[Experiment]) -> tuple[tuple[Hum, ...], tuple[Experiment, ...]]:
    """Return the hum of every output, and the experiments without it.

    A line counts where all experiments together show it beyond chance. An experiment whose input has one there is left as it is:
    the rig answers to that. Every ten seconds have a phase, an amplitude and, within bounds, a frequency of their own.

    Source: windowed least squares; Stoica and Moses, Spectral Analysis of Signals, Pearson 2005, section 4.3.
    """
    found: list[Hum] = []
    kept = list(experiments)
    for channel in dict.fromkeys(channel for e in experiments for channel in e.outputs):
        for mains in MAINS:
            lines = {place: _lines(e, channel, mains) for place, e in enumerate(kept)}
            several = [line for own in lines.values() for line in own]
            if not _beyond_chance(several):
                continue
            for place, own in lines.items():
                kept[place] = _subtracted(kept[place], channel, own)
            unit = next(e.outputs[channel].unit for e in kept if channel in e.outputs)
            frequency = float(np.median([line.frequency for line in several]))
            found.append(
                Hum(channel, unit, frequency, float(np.sqrt(np.mean([abs(x.amplitude) ** 2 for x in several]))))
            )
    return tuple(found), tuple(kept)


def _lines(experiment: Experiment, channel: str, mains: float) -> list[_Line]:
    """Return the largest line of an output near a frequency, part by part; none where it cannot be told, or an input has it."""
    signal = experiment.outputs.get(channel)
    interval = experiment.sample_time
    parts = int(np.ceil(experiment.duration / _LONGEST))
    edges = np.linspace(0, experiment.samples, max(parts, 1) + 1).astype(int)
    if signal is None or np.min(np.diff(edges)) < _FEWEST or mains > _BELOW_NYQUIST / (2 * interval):
        return []
    sections = [slice(a, b) for a, b in itertools.pairwise(edges)]
    for given in experiment.inputs.values():
        values = np.asarray(given.values)
        if np.ptp(values) > 0 and _beyond_chance([_largest(values, part, interval, mains) for part in sections]):
            return []
    values = filled(np.asarray(signal.values))
    return [_largest(values, part, interval, mains) for part in sections]


def _largest(values: Values, part: slice, interval: float, mains: float) -> _Line:
    """Return the largest line of a part within reach of a frequency, and its ratio and that of the next to the mean around."""
    piece = values[part]
    count = len(piece)
    window = np.hanning(count)
    piece = (piece - np.mean(piece)) * window
    power = np.abs(np.fft.rfft(piece)) ** 2
    place = mains * count * interval
    reach = max(_WITHIN * place, 0.5)
    apart = np.abs(np.arange(len(power)) - place) - reach
    around = power[(apart > _APART) & (apart < _APART + _BESIDE / 2)]
    several = np.linspace(place - reach, place + reach, int(2 * reach * _FINE) + 1)
    size = scipy.signal.zoom_fft(
        piece, several[[0, -1]] * 2 / count, m=len(several), endpoint=True
    )  # 2 is the sampling rate
    best = int(np.argmax(np.abs(size)))
    mean = max(float(np.mean(around)), 1e-300)
    ratio, others = float(np.abs(size[best]) ** 2 / mean), float(np.max(around) / mean)
    return _Line(
        part, ratio, others, float(several[best] / (count * interval)), complex(2 * size[best] / np.sum(window))
    )


def _beyond_chance(lines: Sequence[_Line]) -> bool:
    """Return whether lines are together larger than the power around them makes them by chance, and than any line there.

    Harmonics of an input that repeats stand side by side.
    """
    ratio = float(np.mean([line.ratio for line in lines])) if lines else 0.0
    if ratio <= np.mean([line.others for line in lines] or [0.0]):
        return False
    # The largest of some frequencies within reach was taken, in every part.
    tried = (2 * _APART + 1) ** len(lines)
    p_value = scipy.stats.f.logsf(ratio, 2 * len(lines), _BESIDE * len(lines)) + np.log(tried)
    return bool(p_value < np.log(_CHANCE))


def _subtracted(experiment: Experiment, channel: str, lines: Sequence[_Line]) -> Experiment:
    """Return the experiment without these lines of an output."""
    if not lines:
        return experiment
    signal = experiment.outputs[channel]
    values = np.array(signal.values)
    for part, _, _, frequency, amplitude in lines:
        turns = 2j * np.pi * frequency * experiment.sample_time * np.arange(part.stop - part.start)
        values[part] -= np.real(amplitude * np.exp(turns))
    return replace(experiment, outputs={**experiment.outputs, channel: replace(signal, values=values)})
