"""Numbers of NumPy as arrays of JAX, with nothing compiled for it, and whether numbers are known or traced."""

from collections.abc import Sequence

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from rtac_jax._numbers import Number


def to_jax(value: Number | Sequence[Number]) -> jax.Array:
    """Return a copy of an array of NumPy as one of JAX; anything else as `jnp.asarray` does.

    `jnp.asarray` compiles a program for each shape, of which a diagnosis has fifty. Not for traced code, where it would be a
    step of the program.
    """
    # Of a copy, as the array may go on using the memory that it is given.
    return jax.device_put(np.array(value)) if isinstance(value, np.ndarray) else jnp.asarray(value)


def is_traced(*trees: object) -> bool:
    """Return whether JAX traces any number in these, to compile, to differentiate or to batch."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))
