"""Experiments repeated up to one of a few numbers, so that recordings of other numbers run the same compiled code."""

import dataclasses
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from estimators.core.data import Data
from estimators.core.parameter_space import Space
from rtac_jax.time_loop import SHORT

Tree = TypeVar("Tree")

# More of them fill vectors of the processor, and one more takes its time.
_FEW = 8
OWN = ("each_values", "start", "start_scale", "start_spread", "start_held")
"""What of a `Space` each experiment has for itself."""


def repeated(data: Data) -> Int[np.ndarray, " place"] | None:
    """Return the places of experiments, the last of them repeated up to a power of two; None where there is nothing to repeat.

    Only a few short ones are: then to compile takes longer than to compute, and vectors are half empty.
    """
    count = data.experiments
    wide = 1 << (count - 1).bit_length()
    if data.room > SHORT or count > _FEW or wide == count:
        return None
    return np.minimum(np.arange(wide), count - 1)


def taken(tree: Tree, places: Any) -> Tree:
    """Return the experiments at some places of arrays whose last axis they are; numbers stay as they are."""

    def of(leaf: Any) -> Any:
        return jnp.asarray(np.asarray(leaf)[..., places]) if np.ndim(leaf) else leaf

    return jax.tree.map(of, tree)


def taken_of_space(space: Space, places: Any) -> Space:
    """Return the space of the experiments at some places."""
    return dataclasses.replace(space, **{name: taken(getattr(space, name), places) for name in OWN})
