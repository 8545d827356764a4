"""The price of an envelope: the same demands, met as well as each envelope lets them be."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from rtac_jax.control._checks import Linear, zeros_of
from rtac_jax.control._synthesis import Synthesis, mixed_sensitivity
from rtac_jax.control._weights import Weights, propose_weights


@dataclasses.dataclass(frozen=True)
class Price:
    """Gamma for the same demands on several envelopes, and the damping that each can be promised.

    Attributes:
        gamma: by name, under common demands; above 1 the demands cannot be promised for all plants of the envelope.
        damping: by name, of the dominant mode [1/s], as `propose_weights` dares to ask for it.
        syntheses: by name, under common demands.
    """

    gamma: dict[str, float]
    damping: dict[str, float]
    syntheses: dict[str, Synthesis]

    def __str__(self) -> str:
        width = max(len(name) for name in self.gamma)
        lines = [f"{'envelope':{width}s}   gamma   damping to ask for"]
        lines += [f"{name:{width}s} {self.gamma[name]:7.3f} {self.damping[name]:10.2f} 1/s" for name in self.gamma]
        return "\n".join(lines)


def price(envelopes: Mapping[str, tuple[Linear, Linear]], torque_limit: float, *, displacement: float) -> Price:
    """Compare gamma over envelopes, for instance before and after a missing effect is added to the model.

    The demands on performance and effort are those that `propose_weights` makes of the last envelope; each envelope
    brings its own P_0 and W.

    Args:
        envelopes: nominal plant and multiplicative weight by name, for instance "without" and "with" an effect.
        torque_limit: as in `propose_weights`.
        displacement: as in `propose_weights`.

    Raises:
        ValueError: fewer than two envelopes, or as `propose_weights` and `mixed_sensitivity`.
    """
    if len(envelopes) < 2:
        raise ValueError(f"price compares envelopes, but was given {len(envelopes)}; give at least two.")
    proposed = {
        name: propose_weights(nominal, weight, torque_limit, displacement=displacement)
        for name, (nominal, weight) in envelopes.items()
    }
    demands = proposed[list(envelopes)[-1]]
    found = {
        name: mixed_sensitivity(
            nominal,
            Weights(demands.effort, proposed[name].uncertainty, demands.performance, demands.desired),
            relax=1.0,
            limit=float("inf"),
        )
        for name, (nominal, _) in envelopes.items()
    }
    return Price(
        gamma={name: one.gamma for name, one in found.items()},
        damping={name: float(-np.max(np.real(zeros_of(weights.desired)))) for name, weights in proposed.items()},
        syntheses=found,
    )
