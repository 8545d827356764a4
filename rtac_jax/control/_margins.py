"""Guarantees of a controller over the envelope: robust stability and robust performance over frequency."""

import dataclasses

import control as ct
import numpy as np
from jaxtyping import Float

from rtac_jax.control._checks import (
    Linear,
    closed,
    finite_response,
    is_stable,
    plant_of,
    poles_of,
    recursion_of,
    state_space,
)
from rtac_jax.control._synthesis import frequencies, loop_functions
from rtac_jax.control._weights import Weights

Curve = Float[np.ndarray, " frequency"]


@dataclasses.dataclass(frozen=True)
class Margins:
    """Robustness over frequency.

    Attributes:
        frequency: [rad/s].
        stability: |W T|; all plants of the envelope are stable if it is below 1 everywhere.
        performance: |W T| + |W_3 W_d S|, the structured singular value of the robust performance problem of one input and
            one output; all plants of the envelope keep |W_3 W_d S| < 1 if it is below 1 everywhere.
        disk: distance of the open loop from -1, |1 + L| = 1/|S|.
    """

    frequency: Curve
    stability: Curve
    performance: Curve
    disk: Curve

    @property
    def worst_stability(self) -> tuple[float, float]:
        """Largest |W T| and its frequency [rad/s]."""
        return _peak(self.frequency, self.stability)

    @property
    def worst_performance(self) -> tuple[float, float]:
        """Largest |W T| + |W_3 W_d S| and its frequency [rad/s]."""
        return _peak(self.frequency, self.performance)

    def __str__(self) -> str:
        (rs, at_rs), (rp, at_rp) = self.worst_stability, self.worst_performance
        return (
            f"Robust stability {rs:.3f} at {at_rs:.3g} rad/s ({'kept' if rs < 1 else 'not guaranteed'}), robust performance "
            f"{rp:.3f} at {at_rp:.3g} rad/s ({'kept' if rp < 1 else 'not guaranteed'}), distance from -1 at least "
            f"{np.min(self.disk):.2f}."
        )


def margins(nominal: Linear, controller: Linear, weights: Weights) -> Margins:
    """Return robust stability and performance of the loop u = -C y with multiplicative uncertainty.

    Args:
        nominal: continuous.
        controller: continuous, or a recursion: then the plant's input is held between samples, and the curves go up to half of
            the sampling rate. What a plant of the envelope does beyond is taken to be small, as it folds down.
        weights: continuous.

    Source: Doyle, Francis and Tannenbaum, Feedback Control Theory (1992), sections 4.2 and 4.3.

    Raises:
        ValueError: the nominal loop is not stable, so that it has no margins, or a system is not finite or not one-to-one, or
            discrete without a sample time.
    """
    plant = plant_of(nominal)
    frequency = frequencies(plant, weights)
    if controller.dt:
        law, interval = recursion_of(controller)
        held = state_space(ct.sample_system(plant, interval, method="zoh"))
        stable = np.all(np.abs(poles_of(closed(held, law))) < 1)
        frequency = frequency[frequency < np.pi / interval]
        z = np.exp(1j * frequency * interval)
        loop = np.asarray(law(z)) * np.asarray(held(z))
        s, t = 1 / (1 + loop), loop / (1 + loop)
    else:
        stable = is_stable(closed(plant, plant_of(controller)))
        s, t, _ = loop_functions(plant, controller, frequency)
    if not stable:
        raise ValueError("the nominal closed loop is not stable; its margins mean nothing.")
    robust = np.abs(finite_response(weights.uncertainty, frequency, "the uncertainty weight") * t)
    fast = np.abs(finite_response(weights.performance, frequency, "the performance weight") * s)
    return Margins(frequency, robust, robust + fast, 1 / np.abs(s))


def _peak(frequency: Curve, curve: Curve) -> tuple[float, float]:
    place = int(np.argmax(curve))
    return float(curve[place]), float(frequency[place])
