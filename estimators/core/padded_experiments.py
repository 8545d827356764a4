"""Recordings padded by copies of an experiment to one of a few numbers, so that others of near size run the same compiled code."""

import dataclasses
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Int

from estimators.core.data import Data
from estimators.core.parameter_space import Space
from rtac_jax.programs.arrays import to_jax
from rtac_jax.time_loop import SHORT

Tree = TypeVar("Tree")

# More of them fill vectors of the processor, and one more takes its time.
_FEW = 8
_OWN = ("each_values", "start", "start_scale", "start_spread", "start_held")  # that a `Space` has for each experiment


def padded_places(data: Data) -> Int[np.ndarray, " place"] | None:
    """Return the places of experiments, that of the last repeated up to a power of two; None where nothing has to be padded.

    Only a few short ones are: then to compile takes longer than to compute, and vectors are half empty.
    """
    count = data.experiments
    wide = 1 << (count - 1).bit_length()
    if data.room > SHORT or count > _FEW or wide == count:
        return None
    return np.minimum(np.arange(wide), count - 1)


def padded(data: Data, space: Space, *others: Array | None) -> tuple[Any, ...]:
    """Return data, space and arrays whose last axis are their experiments, padded."""
    places = padded_places(data)
    if places is None:
        return data, space, *others
    return experiments_at(data, places), space_at(space, places), *experiments_at(others, places)


def experiments_at(tree: Tree, places: Int[np.ndarray, " place"] | slice) -> Tree:
    """Return the experiments at some places of arrays whose last axis they are; numbers stay as they are."""

    def of(leaf: Array | np.ndarray | float) -> Array | np.ndarray | float:
        return to_jax(np.asarray(leaf)[..., places]) if np.ndim(leaf) else leaf

    return jax.tree.map(of, tree)


def space_at(space: Space, places: Int[np.ndarray, " place"] | slice) -> Space:
    """Return the space of the experiments at some places."""
    return dataclasses.replace(space, **{name: experiments_at(getattr(space, name), places) for name in _OWN})
