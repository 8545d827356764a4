"""Test of a lagged force: innovations held against forces that follow past motion or current with a lag.

A static function of the present state cannot show hysteresis, viscoelasticity or an unknown mode; these can.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.signal import lfilter

from estimators.core.threads import at_once
from estimators.misspecification.score_test import score_test
from estimators.prediction_error.innovations import Innovations, Rows
from rtac_jax.measurement import Experiment, filled

# Time constants as fractions of the period of the motion.
_LAGS = (0.02, 0.06, 0.2, 0.6, 2.0)


@dataclasses.dataclass(frozen=True)
class DelayedForce:
    """The explanation that a force lagging behind one signal would give.

    Attributes:
        port: "cart" or "arm".
        follows: the signal that it follows.
        explains: twice the gain in log-likelihood.
        excess: that, less what chance explains.
        p_value: for this signal alone.
    """

    port: str
    follows: str
    explains: float
    excess: float
    p_value: float


def delayed_forces(
    innovations: Innovations,
    error: np.ndarray,
    basis: Rows,
    experiments: Sequence[Experiment],
    *,
    frequency: float,
    stiffness: float,
) -> list[DelayedForce]:
    """Test forces that follow the cart's position, the arm's velocity and the current with lags, best first.

    Args:
        innovations: of the base model, with its derivatives.
        error: the innovations as rows, without their part in the basis.
        basis: orthonormal columns that the base model's parameters explain already.
        experiments: whose measurements the forces follow.
        frequency: of the motion [rad/s].
        stiffness: that turns a position into a force of plausible size [N/m].

    Only measurements up to the present are used, so that without a missing effect the innovations do not depend on them.
    """
    lags = [fraction * 2 * np.pi / frequency for fraction in _LAGS]
    position = _lagged(experiments, "outputs", "cart_position", lags, innovations)
    velocity = _lagged(experiments, "outputs", "arm_velocity", lags, innovations)
    current = _lagged(experiments, "inputs", "current", lags, innovations)
    nothing = np.zeros_like(position)
    typical = float(np.std(current)) or 1.0
    velocity = velocity * typical / (float(np.std(velocity)) or 1.0)
    blocks = innovations.blocks()

    def delayed(one: tuple[str, str, tuple[np.ndarray, np.ndarray]]) -> DelayedForce:
        port, follows, along = one
        test = score_test(innovations.pushed(*along), error, basis, blocks)
        return DelayedForce(port, follows, test.explained, test.excess, test.p_value)

    several = [
        ("cart", "cart_position", (nothing, stiffness * position)),
        ("arm", "arm_velocity", (velocity, nothing)),
        ("arm", "current", (current, nothing)),
    ]
    found = at_once(delayed, [one for one in several if np.any(one[2])])
    return sorted(found, key=lambda one: -one.excess)


def _lagged(
    experiments: Sequence[Experiment], group: str, channel: str, lags: Sequence[float], innovations: Innovations
) -> np.ndarray:
    """Return the signal behind first-order lags, [lag sample experiment]; zero where it was not recorded."""
    found = np.zeros((len(lags), innovations.data.room, len(experiments)))
    for column, e in enumerate(experiments):
        signals = getattr(e, group)
        if channel not in signals:
            continue
        values = filled(signals[channel].values)
        for row, lag in enumerate(lags):
            keep = np.exp(-e.sample_time / lag)
            found[row, : len(values), column] = lfilter([1 - keep], [1, -keep], values, zi=[keep * values[0]])[0]
    return found
