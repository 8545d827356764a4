"""Cases side by side: how many, and their arrays with the columns of all."""

from collections.abc import Iterable
from typing import TypeVar

import jax
import numpy as np

Tree = TypeVar("Tree")

# Experiments side by side in one compiled loop: fewer fill no vectors, more wait for the last fits that descend.
_COLUMNS = 48
# Places are a multiple of as many numbers as the widest registers hold: no compiled loop has a remainder that is computed by
# other instructions, and a fit has the same bits in any place.
_WIDTH = 8


def places_for(experiments: int) -> int:
    """Return how many cases of so many experiments are fitted side by side: one number, however many cases there are."""
    return _WIDTH * max(1, round(_COLUMNS / (_WIDTH * experiments)))


def side_by_side(parts: Iterable[Tree]) -> Tree:
    """Return arrays with the columns of all; what has no axis is the same in all."""
    return jax.tree.map(lambda *x: np.concatenate(x, axis=-1) if np.ndim(x[0]) else x[0], *parts)
