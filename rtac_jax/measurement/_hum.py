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

MAINS = (50.0, 60.0, 100.0, 120.0)  # of both grids, and twice each, as rectifiers give it [Hz]
_WITHIN = 0.004  # of the frequency, within which it is looked for: a large grid keeps within half of that
_LONGEST = 10.0  # s over which the frequency of a grid holds to a fraction of a turn
_BESIDE = 15  # lines on each side that tell the power without hum
_APART = 3  # lines over which a Hann window spreads a sine, on each side
_FINE = 8  # frequencies tried per line of the spectrum
_CHANCE = 1e-6  # of hum where there is none, for one channel and frequency
_ITS_OWN = 0.01  # the same of one experiment, where the others show it
# Of the power of an input near a frequency of the mains, or near the second to the fifth part of one, whose harmonics are no hum.
_DRIVEN, _HARMONICS = 1e-3, 5
_AS_LARGE = 0.2  # of the hum where nothing drives, within which a line is hum though the input may have made one


@dataclass(frozen=True)
class Hum:
    """A sine of the mains in one output.

    Attributes:
        channel: the output.
        unit: of it.
        frequency: of the mains, or twice that [Hz].
        amplitude: root mean square of the amplitudes where it was subtracted, in the unit of the channel.
    """

    channel: str
    unit: str
    frequency: float
    amplitude: float

    def __str__(self) -> str:
        return f"{self.channel} {self.amplitude:.2g} {self.unit} at {self.frequency:.4g} Hz"


def hum_subtracted(hum: Sequence[Hum]) -> str:
    """Return what was subtracted, in words; nothing where there was none."""
    if not hum:
        return ""
    return f"Hum of the mains was subtracted first: {' and '.join(map(str, hum))}. What was fitted is recording.without_hum()."


class _Line(NamedTuple):
    """The largest line near a frequency in a part of a signal; ratios are powers over the mean power beside it."""

    part: slice
    ratio: float
    next_ratio: float
    frequency: float
    amplitude: complex
    tried: float


def without_hum(experiments: Sequence[Experiment]) -> tuple[tuple[Hum, ...], tuple[Experiment, ...]]:
    """Return the hum of every output, and the experiments without it.

    It is there where the experiments that nothing drives show it together beyond chance: what a driven rig answers may have a line
    anywhere. Then it is subtracted from all that show it, but for those whose input has power near it, or near a frequency of which
    it is a harmonic, if their line is larger or smaller. Every ten seconds have a phase, an amplitude and, within bounds, a
    frequency of their own.

    Source: windowed least squares; Stoica and Moses, Spectral Analysis of Signals, Pearson 2005, section 4.3.
    """
    found: list[Hum] = []
    kept = list(experiments)
    for channel in dict.fromkeys(channel for e in experiments for channel in e.outputs):
        for mains in MAINS:
            lines = {place: _lines(e, channel, mains) for place, e in enumerate(kept)}
            idle = [line for place, own in lines.items() for line in own if _is_idle(kept[place])]
            shown = {place: own for place, own in lines.items() if _beyond_chance(own, _ITS_OWN)}
            idle_shown = [line for place, own in shown.items() for line in own if _is_idle(kept[place])]
            if not idle_shown or not _beyond_chance(idle, _CHANCE):
                continue
            size = _size(idle_shown)
            hummed = {
                place: own
                for place, own in shown.items()
                if not _is_driven(kept[place], mains) or abs(_size(own) - size) < _AS_LARGE * size
            }
            for place, own in hummed.items():
                kept[place] = _subtracted(kept[place], channel, own)
            several = [line for own in hummed.values() for line in own]
            unit = next(e.outputs[channel].unit for e in kept if channel in e.outputs)
            frequency = float(np.median([line.frequency for line in several]))
            found.append(Hum(channel, unit, frequency, _size(several)))
    return tuple(found), tuple(kept)


def _size(lines: Sequence[_Line]) -> float:
    """Return the root mean square of the amplitudes."""
    return float(np.sqrt(np.mean([abs(line.amplitude) ** 2 for line in lines])))


def _is_idle(experiment: Experiment) -> bool:
    """Return whether nothing drives the rig."""
    return not any(np.any(signal.values) for signal in experiment.inputs.values())


def _is_driven(experiment: Experiment, mains: float) -> bool:
    """Return whether an input has power near a frequency, or near one of which it is a harmonic; a constant one drives all."""
    for signal in experiment.inputs.values():
        values = filled(np.asarray(signal.values))
        if not np.any(values):
            continue
        if np.ptp(values) == 0:
            return True
        power = np.abs(np.fft.rfft((values - np.mean(values)) * np.hanning(len(values)))) ** 2
        place = mains * len(values) * experiment.sample_time
        for k in range(1, _HARMONICS + 1):
            near = np.abs(np.arange(len(power)) - place / k) <= _WITHIN * place / k + _APART
            if np.sum(power[near]) > _DRIVEN * np.sum(power):
                return True
    return False


def _lines(experiment: Experiment, channel: str, mains: float) -> list[_Line]:
    """Return the largest line of an output near a frequency, part by part; none where a part does not tell it."""
    signal = experiment.outputs.get(channel)
    interval = experiment.sample_time
    if signal is None or mains * interval >= 0.5:  # beyond half of the sampling rate a sine is its mirror image
        return []
    parts = max(1, int(np.ceil(experiment.duration / _LONGEST)))
    edges = np.linspace(0, experiment.samples, parts + 1).astype(int)
    values = np.asarray(signal.values)
    found = [_largest(values, slice(a, b), interval, mains) for a, b in itertools.pairwise(edges)]
    return [line for line in found if line is not None]


def _largest(values: Values, part: slice, interval: float, mains: float) -> _Line | None:
    """Return the largest line of a part within reach of a frequency; None where it is none, or motion would not be told from it."""
    count = part.stop - part.start
    place = mains * count * interval
    reach = max(_WITHIN * place, 0.5)
    around = reach + _APART + _BESIDE
    # Slow motion takes the lowest lines, and what lies beside it must lie below half of the sampling rate, too.
    if place - around < around or place + around > count // 2 or np.sum(np.isfinite(values[part])) < count // 2:
        return None
    window = np.hanning(count)
    piece = filled(values[part])
    piece = (piece - np.mean(piece)) * window
    power = np.abs(np.fft.rfft(piece)) ** 2
    apart = np.abs(np.arange(len(power)) - place)
    beside = power[(apart > reach + _APART) & (apart < around)]
    several = np.linspace(place - reach, place + reach, int(2 * reach * _FINE) + 1)
    size = scipy.signal.zoom_fft(
        piece, several[[0, -1]] * 2 / count, m=len(several), endpoint=True
    )  # 2: the sampling rate
    best = int(np.argmax(np.abs(size)))
    mean = max(float(np.mean(beside)), 1e-300)
    ratio, next_ratio = float(np.abs(size[best]) ** 2 / mean), float(np.max(beside) / mean)
    if best in (0, len(several) - 1):  # the foot of a line that lies beyond
        ratio = 0.0
    frequency = float(several[best] / (count * interval))
    # What bridges missing samples has no hum.
    amplitude = complex(2 * size[best] / np.sum(window[np.isfinite(values[part])]))
    return _Line(part, ratio, next_ratio, frequency, amplitude, 2 * reach + 1)


def _beyond_chance(lines: Sequence[_Line], level: float) -> bool:
    """Return whether lines are together larger than the power beside them makes them by chance, and than any line there.

    Harmonics of a motion that repeats stand side by side.
    """
    if not lines or np.mean([line.ratio for line in lines]) <= np.mean([line.next_ratio for line in lines]):
        return False
    ratio = float(np.mean([line.ratio for line in lines]))
    # The largest of those within reach was taken, in every part.
    tried = float(np.sum(np.log([line.tried for line in lines])))
    return bool(scipy.stats.f.logsf(ratio, 2 * len(lines), 4 * _BESIDE * len(lines)) + tried < np.log(level))


def _subtracted(experiment: Experiment, channel: str, lines: Sequence[_Line]) -> Experiment:
    """Return the experiment without these lines of an output."""
    signal = experiment.outputs[channel]
    values = np.array(signal.values)
    for line in lines:
        turns = 2j * np.pi * line.frequency * experiment.sample_time * np.arange(line.part.stop - line.part.start)
        values[line.part] -= np.real(line.amplitude * np.exp(turns))
    return replace(experiment, outputs={**experiment.outputs, channel: replace(signal, values=values)})
