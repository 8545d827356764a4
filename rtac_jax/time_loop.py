"""A scan whose length the compiler does not know, so that recordings of many lengths run the same compiled code."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_SHORTEST = 64


def room_for(samples: int) -> int:
    """Return the length of arrays that hold so many samples: one of a few, each about 1.4 times the one before.

    Code is compiled for a length of the arrays and stops after the samples that there are.
    """
    if samples <= _SHORTEST:
        return _SHORTEST
    return int(np.ceil(_SHORTEST * 2.0 ** (0.5 * np.ceil(2 * np.log2(samples / _SHORTEST)) - 1e-12)))


def time_loop(
    step: Callable[[Any, Any], tuple[Any, Any]], carry: Any, rows: Any, *, room: int, samples: Any
) -> tuple[Any, Any]:
    """Scan as `jax.lax.scan` does, over the first `samples` of the rows; all other results are zero.

    Forward derivatives only.

    Args:
        step: from the carry and a row to the carry and what is shown.
        carry: at the start.
        rows: arrays, or trees of them, with `room` along their first axis.
        room: length of the rows and of the results.
        samples: a number of steps; an array compiles once for all numbers.
    """

    def row_at(k: Any) -> Any:
        return jax.tree.map(lambda x: jax.lax.dynamic_index_in_dim(x, k, keepdims=False), rows)

    def onward(k: Any, at: tuple[Any, Any]) -> tuple[Any, Any]:
        carry, shown = at
        carry, new = step(carry, row_at(k))
        place = jax.lax.dynamic_update_index_in_dim
        return carry, jax.tree.map(lambda all_of_it, one: place(all_of_it, one, k, 0), shown, new)

    shapes = jax.eval_shape(step, carry, jax.eval_shape(row_at, 0))[1]
    shown = jax.tree.map(lambda x: jnp.zeros((room, *x.shape), x.dtype), shapes)
    return jax.lax.fori_loop(0, jnp.asarray(samples), onward, (carry, shown))
