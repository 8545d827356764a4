"""A velocity that is made of an encoder's counts, by the difference of one sample to the next or over a window."""

import numpy as np

from ._experiment import Experiment
from ._momentary_faults import resolution

_FEWEST = 64  # counts in a turn, of the coarsest encoder
_NEAR = 0.02  # of a count, which rounding leaves; with a multiple of four, as a quadrature gives it, chance is one in a hundred


def counts_differenced(experiment: Experiment) -> int:
    """Return into how many counts a turn is divided if an arm's velocity is made of such; zero if not, or if the angle is there.

    Over a window of several samples it is as many times the encoder's.

    Args:
        experiment: in which the arm may turn.
    """
    signal = experiment.outputs.get("arm_velocity")
    if signal is None or "arm_angle" in experiment.outputs or experiment.holds("arm_velocity"):
        return 0
    step = resolution(signal.values[np.isfinite(signal.values)])
    counts = 2 * np.pi / (step * experiment.sample_time) if step > 0 else 0.0
    whole = round(counts)
    return whole if whole >= _FEWEST and whole % 4 == 0 and abs(counts - whole) < _NEAR else 0
