"""A scan whose length the compiler does not know, so that recordings of many lengths run the same compiled code."""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

Carry = TypeVar("Carry")
Row = TypeVar("Row")
Shown = TypeVar("Shown")

_SHORTEST = 64
SHORT = 4096
"""Samples up to which arrays are small, and to compile takes longer than to fill room that is not used."""


def room_for(samples: int) -> int:
    """Return the length of arrays that hold so many samples: one of a few, each twice or, of long ones, 1.4 times the one before.

    Code is compiled for a length of the arrays and stops after the samples that there are.
    """
    if samples <= _SHORTEST:
        return _SHORTEST
    steps = 1 if samples <= SHORT else 2  # to twice the length
    return int(np.ceil(_SHORTEST * 2.0 ** (np.ceil(steps * np.log2(samples / _SHORTEST)) / steps - 1e-12)))


def time_loop(
    step: Callable[[Carry, Row], tuple[Carry, Shown]],
    carry: Carry,
    rows: Row,
    *,
    room: int,
    samples: int | Int[Array, ""],
) -> tuple[Carry, Shown]:
    """Scan as `jax.lax.scan` does, over the first `samples` of the rows; all other results are zero.

    Forward derivatives only. What is shown in arrays of one shape is kept in one array: of two of them XLA for processors
    writes both by one loop, and copies one of them whole in every step.

    Args:
        step: from the carry and a row to the carry and what is shown.
        carry: at the start.
        rows: arrays, or trees of them, with `room` along their first axis.
        room: length of the rows and of the results.
        samples: a number of steps; an array compiles once for all numbers.
    """
    # Traced once, for its shape, for the body of the loop, and for each round in which JAX looks for what has derivatives.
    step = jax.jit(step)

    def row_at(k: Array) -> Any:
        return jax.tree.map(lambda x: jax.lax.dynamic_index_in_dim(x, k, keepdims=False), rows)

    def onward(k: Array, at: tuple[Any, Any]) -> tuple[Any, Any]:
        carry, shown = at
        carry, new = step(carry, row_at(k))
        leaves = jax.tree.leaves(new)
        together = [
            leaves[places[0]] if len(places) == 1 else jnp.stack([leaves[p] for p in places]) for places in alike
        ]
        put = jax.lax.dynamic_update_index_in_dim
        return carry, [put(all_of_it, one, k, 0) for all_of_it, one in zip(shown, together, strict=True)]

    shapes, structure = jax.tree.flatten(jax.eval_shape(step, carry, jax.eval_shape(row_at, 0))[1])
    alike = _alike(shapes)
    many = [(len(places),) if len(places) > 1 else () for places in alike]
    ones = [shapes[places[0]] for places in alike]
    shown = [jnp.zeros((room, *several, *one.shape), one.dtype) for several, one in zip(many, ones, strict=True)]
    carry, shown = jax.lax.fori_loop(0, jnp.asarray(samples), onward, (carry, shown))
    apart = {
        place: found[:, i] if len(places) > 1 else found
        for found, places in zip(shown, alike, strict=True)
        for i, place in enumerate(places)
    }
    return carry, jax.tree.unflatten(structure, [apart[place] for place in range(len(shapes))])


def _alike(shapes: Sequence[jax.ShapeDtypeStruct]) -> list[list[int]]:
    """Return the places of arrays of one shape and type, for each of them."""
    found: dict[Any, list[int]] = {}
    for place, one in enumerate(shapes):
        found.setdefault((one.shape, one.dtype), []).append(place)
    return list(found.values())
