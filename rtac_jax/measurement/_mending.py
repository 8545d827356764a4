"""Mending of what loggers lose: rows that are missing between others, and samples that are no measurement."""

import dataclasses
from collections.abc import Collection, Mapping

import numpy as np
from jaxtyping import Float64

from ._clock import nearest_clock, rounding
from ._experiment import Experiment
from ._momentary_faults import faulty, resolution
from ._signal import INPUTS

Values = Float64[np.ndarray, " sample"]

_OFF = 0.02  # of a step, by which the times of rows that remain may be off the clock: ten times what rounding makes
_TICK = 0.6  # of what times are rounded to, half of which rounding takes them off
_MOST = 0.1  # of all rows, that may be lost


def mended(experiment: Experiment) -> Experiment:
    """Return an experiment whose clipped samples, dropouts and spikes are missing; the same where there are none, or at rest."""
    if experiment.kind == "rest":
        return experiment
    outputs = {}
    for name, signal in experiment.outputs.items():
        bad = np.zeros(len(signal.values), dtype=bool) if experiment.holds(name) else faulty(name, signal.values)
        left = np.where(bad, np.nan, signal.values)
        outputs[name] = dataclasses.replace(signal, values=left) if bad.any() else signal
    if all(outputs[name] is signal for name, signal in experiment.outputs.items()):
        return experiment
    return dataclasses.replace(experiment, outputs=outputs)


def places_of_rows(times: Values) -> np.ndarray | None:
    """Return the places of rows on a uniform clock of which some are lost; None where their times are not on one.

    Times that are rounded as coarsely as the clock ticks skip one now and then, at even distances, where nothing is lost.

    Args:
        times: of the rows that there are [s], rising.
    """
    steps = np.diff(times)
    if not len(steps) or not np.all(steps > 0):
        return None
    places = np.concatenate([[0], np.cumsum(np.round(steps / np.median(steps)))]).astype(np.int64)
    lost = int(places[-1]) + 1 - len(times)
    if not 0 < lost <= _MOST * len(times):
        return None
    if _is_rounded(times):
        return None
    step, farthest = nearest_clock(times, places)
    return places if farthest < max(_OFF * step, rounding(times, step)) else None


def with_rows(signals: Mapping[str, Values], places: np.ndarray, *, held: Collection[str]) -> dict[str, Values]:
    """Return channels with the rows that were lost: outputs are missing there, and inputs run on from row to row.

    Args:
        signals: by channel, of the rows that there are.
        places: of these among all.
        held: inputs that stay what they are until the next sample; others go straight to it.
    """
    at = np.arange(int(places[-1]) + 1)
    before = np.searchsorted(places, at, side="right") - 1

    def whole(channel: str, values: Values) -> Values:
        if channel not in INPUTS:
            return np.where(places[before] == at, values[before], np.nan)
        return values[before] if channel in held else np.interp(at, places, values)

    return {channel: whole(channel, values) for channel, values in signals.items()}


def _is_rounded(times: Values) -> bool:
    """Return whether a uniform clock and the rounding of its times explain them all."""
    _, off = nearest_clock(times, np.arange(len(times)))
    several = np.count_nonzero(np.diff(times) > 1.5 * np.median(np.diff(times))) > 1  # one alone is a row as likely
    return bool(several and off <= _TICK * resolution(times))
