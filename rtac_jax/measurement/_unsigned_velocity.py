"""A velocity without a sign, as of a sensor that counts pulses."""

import numpy as np

from ._experiment import Experiment

_NEGATIVE = 0.05  # of the largest, that noise may make of nothing
_CLEAR = 0.25  # of the largest, beyond which it turns
_TIMES = 3  # that it comes to nothing between two turns, so that chance is none
_BOTH = 0.3  # of the largest input, that it has of either sign


def returns_unsigned(experiment: Experiment) -> int:
    """Return how often an arm's velocity comes to nothing and never goes below, though an input changes its sign; zero if not so.

    Args:
        experiment: in which the arm may turn.
    """
    signal = experiment.outputs.get("arm_velocity")
    if signal is None or experiment.holds("arm_velocity"):
        return 0
    values = signal.values[np.isfinite(signal.values)]
    most = float(np.max(values, initial=0.0))
    swings = any(
        min(float(np.max(i.values)), -float(np.min(i.values))) > _BOTH * float(np.max(np.abs(i.values))) > 0
        for i in experiment.inputs.values()
    )
    if not swings or most <= 0 or np.min(values) < -_NEGATIVE * most:
        return 0
    level = np.where(values > _CLEAR * most, 1, np.where(values < _NEGATIVE * most, 0, -1))
    level = level[level >= 0]
    times = int(np.sum(np.diff(level) == -1))
    return times if times >= _TIMES else 0
