"""The noise as it is known before a fit: of sensors, random forces, and states at the start."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Array, Float

from estimators.core.data import CHANNELS
from estimators.core.parameter_space import Space
from rtac_jax import Scales
from rtac_jax.measurement import Experiment
from rtac_jax.programs.arrays import to_jax

_SHOWN = 10.0  # how much wider the cart's position at the start is taken to lie than its scale


@dataclasses.dataclass(frozen=True)
class NoiseModel:
    """The prior knowledge of the noise before a fit.

    Attributes:
        sensor: standard deviation of each channel, SI units.
        doubt: standard deviation of the logarithm of its variance.
        force, torque: sizes that scale the process noise [N, N m].
        interval: sample time [s].
        start_variance: of the states at the start.
    """

    sensor: Float[np.ndarray, " output"]
    doubt: Float[np.ndarray, " output"]
    force: float
    torque: float
    interval: float
    start_variance: Float[Array, "start experiment"]

    @classmethod
    def of(
        cls, levels: Mapping[str, float], experiments: Sequence[Experiment], scales: Scales, space: Space
    ) -> "NoiseModel":
        """Build the prior from noise levels; a rest record or a stated level is trusted as far as its length allows."""
        resting = {
            c: sum(e.samples for e in experiments if e.kind == "rest" and c in e.outputs and e.outputs[c].varies)
            for c in CHANNELS
        }
        doubt = [np.sqrt(2.0 / n) + 0.03 if (n := resting[c]) > 0 else 0.5 for c in CHANNELS]
        return cls(
            np.array([levels.get(c, 1.0) for c in CHANNELS]),
            np.array(doubt),
            scales.force,
            scales.torque,
            scales.sample_time,
            start_variance(space),
        )

    def starting(self, space: Space) -> "NoiseModel":
        """Return the same prior for a model with other states."""
        return dataclasses.replace(self, start_variance=start_variance(space))


def start_variance(space: Space) -> Float[Array, "start experiment"]:
    """Return the variance of the states at the start; none where they are held.

    The cart's position, the first of them, is taken from the first samples of a sensor whose gain or offset may be unknown. If
    that held the position, where an experiment begins would make up for a wrong gain, and half of it would be estimated.
    """
    deviation = np.asarray(space.start_scale) * (1 - np.asarray(space.start_held))
    deviation[0] *= _SHOWN
    return to_jax(deviation**2)
