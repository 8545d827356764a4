"""One simulation from states at the start: by compiled code where numbers are known, else with derivatives."""

import operator
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rtac_jax._adjoint import differentiable_states
from rtac_jax._numbers import Number
from rtac_jax._rtac import RTAC
from rtac_jax._substeps_traced import substeps_traced
from rtac_jax.equations import state_at_start
from rtac_jax.excitation import Excitation
from rtac_jax.programs import program
from rtac_jax.programs.arrays import is_traced
from rtac_jax.simulation import MOST_SUBSTEPS, Steps, substeps_for, trajectories

_STABILITY = 0.5  # step times fastest rate; a classic Runge-Kutta step then errs by 0.5^5 / 120 of what that mode moves


def whole_starts(
    model: RTAC, starts: Sequence[Sequence[Number] | np.ndarray | Array], names: Sequence[str], excitation: Excitation
) -> Float[Array | np.ndarray, "state experiment"]:
    """Return every state at the start from four numbers, or all of them, for each experiment.

    Raises:
        ValueError: a start of the wrong length.
    """
    xp = jnp if is_traced(model, starts, excitation) else np
    values = [xp.asarray(start, dtype=float) for start in starts]
    for name, value in zip(names, values, strict=True):
        if value.shape not in {(4,), (len(model.states),)}:
            raise ValueError(f"start of {name} has shape {value.shape}; give 4 or {len(model.states)} numbers.")
    rigid = xp.stack([value[:4] for value in values], axis=1)
    state = state_at_start(model, tuple(jnp.asarray(rigid)), excitation.first_current())
    table = xp.stack([xp.broadcast_to(xp.asarray(x), (len(values),)) for x in state])
    columns = [value if len(value) > 4 else table[:, column] for column, value in enumerate(values)]
    return xp.stack(columns, axis=1)


def run(
    model: RTAC,
    start: Float[Array | np.ndarray, "state experiment"],
    excitation: Excitation,
    *,
    room: int,
    samples: int,
    substeps: int | None,
) -> Float[Array | np.ndarray, "sample state experiment"]:
    """Return the states of all experiments; NumPy's where all numbers are known, JAX's where they are traced."""
    if substeps is not None:
        substeps = operator.index(substeps)
        if substeps < 1:
            raise ValueError(f"substeps is {substeps}; give at least 1, or None for as many as the fastest mode asks.")
    if not is_traced(model, start, excitation):
        steps = substeps if substeps is not None else substeps_for(model, excitation, stability=_STABILITY)
        return np.asarray(
            _states(model, jnp.asarray(start), excitation, room, jnp.asarray(samples), jnp.asarray(steps))
        )
    most = max(MOST_SUBSTEPS, substeps or 0)
    steps = jnp.asarray(substeps or 0)
    if substeps is None:
        steps = substeps_traced(model, excitation, stability=_STABILITY, most=most)
    return differentiable_states(model, jnp.asarray(start), excitation, room, jnp.asarray(samples), steps, most)


@program
def _states(model: RTAC, start: Array, excitation: Excitation, room: int, samples: Steps, substeps: Steps) -> Array:
    return trajectories(model, tuple(start), excitation, room=room, samples=samples, substeps=substeps, states=True)
