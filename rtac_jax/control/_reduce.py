"""Reduction of the synthesised controller to one that a rig can run: fewer states, and samples instead of time."""

import dataclasses
from typing import Literal

import control as ct
import numpy as np

from rtac_jax.control._checks import InfeasibleError, Linear, closed, is_stable, plant_of, poles_of, state_space
from rtac_jax.control._synthesis import Synthesis, closed_gamma

_FEWEST = 4.0  # samples in a period of the resonance
_RATE = 6.0  # samples in the shortest period that the loop must follow


@dataclasses.dataclass(frozen=True)
class Reduction:
    """A controller of lower order.

    Attributes:
        controller: still stabilises the nominal plant.
        gamma: its norm (9).
        original: gamma of the full controller.
        tried: gamma by order, for every order that was tried; infinite where the loop is not stable.
    """

    controller: ct.StateSpace
    gamma: float
    original: float
    tried: dict[int, float]

    def __str__(self) -> str:
        return (
            f"Order {max(self.tried)} -> {self.controller.nstates}: gamma {self.original:.3f} -> {self.gamma:.3f}, "
            "closed loop stable."
        )


def reduce_controller(synthesis: Synthesis, *, order: int | None = None, loss: float = 0.02) -> Reduction:
    """Reduce the controller by balanced truncation, each order checked on the closed loop.

    Args:
        synthesis: of the full controller.
        order: wanted; by default the lowest that loses no more than `loss`.
        loss: of gamma, as a fraction.

    Raises:
        ValueError: the order is not between 1 and the controller's, the loss is negative, or the controller itself is not
            stable, so that it has no balanced realisation.
        InfeasibleError: the controller of the order that was asked for does not stabilise the plant.
    """
    full = synthesis.controller
    if not (np.isfinite(loss) and loss >= 0):
        raise ValueError(f"loss is {loss}, but must be zero or positive.")
    if order is not None and not 1 <= order <= full.nstates:
        raise ValueError(f"order is {order}, but must lie between 1 and {full.nstates}, the controller's own.")
    if not is_stable(full):
        raise ValueError("the controller is not stable by itself and cannot be truncated; keep its full order.")
    tried = {full.nstates: synthesis.gamma}
    orders = range(1, full.nstates) if order is None else [order] if order < full.nstates else []
    for count in orders:
        smaller = _truncated(full, count)
        tried[count] = closed_gamma(synthesis.nominal, smaller, synthesis.weights)
        if order is not None and not np.isfinite(tried[count]):
            raise InfeasibleError(
                f"a controller of order {order} does not stabilise the nominal plant; keep more states."
            )
        if order is not None or tried[count] <= (1 + loss) * synthesis.gamma:
            return Reduction(smaller, tried[count], synthesis.gamma, tried)
    return Reduction(full, synthesis.gamma, synthesis.gamma, tried)


def discretise(
    controller: Linear,
    nominal: Linear,
    sample_time: float,
    *,
    method: Literal["tustin", "foh", "zoh"] = "tustin",
) -> ct.StateSpace:
    """Return the controller as a recursion for the rig's sample time.

    Args:
        controller: continuous.
        nominal: the plant, with which the sampled loop is checked; its input is held between samples.
        sample_time: [s].
        method: "tustin" keeps the frequency response up to a warped axis, "foh" and "zoh" are exact for an input that runs
            straight or is held between samples.

    Raises:
        ValueError: the sample time or the method is wrong.
        InfeasibleError: the sampled loop is not stable, or has fewer than four samples in a period of the plant's resonance.
    """
    if not (np.isfinite(sample_time) and sample_time > 0):
        raise ValueError(f"sample_time is {sample_time}, but must be positive and finite, in seconds.")
    if method not in ("tustin", "foh", "zoh"):
        raise ValueError(f"method is {method!r}; choose 'tustin', 'foh' or 'zoh'.")
    continuous, plant = plant_of(controller), plant_of(nominal)
    found = state_space(ct.sample_system(continuous, sample_time, method=method))
    held = state_space(ct.sample_system(plant, sample_time, method="zoh"))
    radius = float(np.max(np.abs(poles_of(closed(held, found)))))
    if not radius < 1:
        raise InfeasibleError(
            f"the loop sampled every {sample_time:g} s is not stable (largest pole {radius:.4f}); sample faster than "
            f"every {np.pi / _RATE / _crossing(plant, continuous):.2g} s."
        )
    resonance = _resonance(plant)
    if sample_time * resonance > 2 * np.pi / _FEWEST:
        raise InfeasibleError(
            f"sampled every {sample_time:g} s the controller has fewer than {_FEWEST:g} samples in a period of the resonance at "
            f"{resonance:.3g} rad/s, and what lies between them it does not see; sample faster than every "
            f"{2 * np.pi / _FEWEST / resonance:.2g} s."
        )
    return ct.StateSpace(found.A, found.B, found.C, found.D, sample_time, name="controller")


def _resonance(plant: ct.StateSpace) -> float:
    """Return the frequency of the plant's resonance with the largest response [rad/s]; 0 where it has none."""
    places = np.array([p.imag for p in poles_of(plant) if p.imag > abs(p.real)])
    return float(places[np.argmax(np.abs(plant(1j * places)))]) if places.size else 0.0


def _crossing(plant: ct.StateSpace, controller: ct.StateSpace) -> float:
    """Return the highest frequency at which the loop gain is 1 [rad/s]; that of the fastest pole where it never is."""
    places = np.abs(plant.poles())
    frequency = np.geomspace(0.01 * np.min(places[places > 0]), 1e3 * np.max(places), 4000)
    above = np.flatnonzero(np.abs(plant(1j * frequency) * controller(1j * frequency)) >= 1)
    return float(frequency[above[-1]]) if above.size else float(np.max(places))


def _truncated(full: ct.StateSpace, count: int) -> ct.StateSpace:
    found = state_space(ct.balanced_reduction(full, count, method="truncate"))
    return ct.StateSpace(
        found.A, found.B, found.C, found.D, inputs=["cart_position"], outputs=["torque"], name="controller"
    )
