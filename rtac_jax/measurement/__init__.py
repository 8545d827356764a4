"""Measurements: experiments, files, and the signals in them."""

from ._channel_checks import moving_at_rest
from ._columns import ImportOptions
from ._concerns import concerns, contradictions
from ._csv import csv_header
from ._errors import RecordingError
from ._excitation import (
    chirp,
    crest_factor,
    from_rest,
    harmonic_grid,
    multisine,
    positive_negative,
    prbs,
    square_wave,
    steps,
)
from ._experiment import Experiment
from ._filter import central_difference, filled, zero_phase_lowpass
from ._hdf5 import DESIGNED, guarded_by_digest, holds_measurements
from ._hum import Hum, hum_subtracted
from ._info import describe
from ._momentary_faults import resolution, spikes
from ._recording import Recording
from ._signal import INPUTS, OUTPUTS, Signal
from ._stated_unit import FACTORS, ending_unit, foreign_unit, name_and_unit, usual_spelling
from .plan import Plan

__all__ = [
    "DESIGNED",
    "FACTORS",
    "INPUTS",
    "OUTPUTS",
    "Experiment",
    "Hum",
    "ImportOptions",
    "Plan",
    "Recording",
    "RecordingError",
    "Signal",
    "central_difference",
    "chirp",
    "concerns",
    "contradictions",
    "crest_factor",
    "csv_header",
    "describe",
    "ending_unit",
    "filled",
    "foreign_unit",
    "from_rest",
    "guarded_by_digest",
    "harmonic_grid",
    "holds_measurements",
    "hum_subtracted",
    "moving_at_rest",
    "multisine",
    "name_and_unit",
    "positive_negative",
    "prbs",
    "resolution",
    "spikes",
    "square_wave",
    "steps",
    "usual_spelling",
    "zero_phase_lowpass",
]
