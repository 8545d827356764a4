"""The record that a simulation returns."""

from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rtac_jax._rtac import RTAC
from rtac_jax.effects import Outputs

Samples = Float[np.ndarray | Array, " sample"]


class Simulation(eqx.Module):
    """A simulated experiment; arrays of one length.

    They are NumPy's where numbers were given, and JAX's under `jax.jit`, `jax.grad` or `jax.vmap`; a function that JAX
    traces may return one.

    Attributes:
        time: [s].
        cart_position, arm_velocity, arm_angle: as the sensors show them [m, rad/s, rad].
        states: every state of the model by name, SI units.
    """

    time: Samples
    cart_position: Samples
    arm_velocity: Samples
    arm_angle: Samples
    states: Mapping[str, Samples]

    def __repr__(self) -> str:
        if not isinstance(self.time, np.ndarray) or self.time.ndim != 1:
            return f"Simulation({' x '.join(map(str, np.shape(self.time)))} samples, states {', '.join(self.states)})"
        return f"Simulation({len(self.time)} samples, {self.time[-1]:.6g} s, states {', '.join(self.states)})"


def simulation_of(
    model: RTAC,
    states: Float[Array | np.ndarray, "sample state experiment"],
    outputs: Outputs,
    column: int,
    time: Float[Array | np.ndarray, " part"],
) -> Simulation:
    """Return one experiment of several, for as many samples as it has times [s]."""
    xp = np if isinstance(states, np.ndarray) else jnp
    part = slice(0, len(time))
    position, velocity, angle = (
        xp.array(xp.broadcast_to(xp.asarray(y), states[:, 0].shape)[part, column]) for y in outputs
    )
    by_name = {name: xp.array(states[part, row, column]) for row, name in enumerate(model.states)}
    return Simulation(xp.asarray(time), position, velocity, angle, by_name)
