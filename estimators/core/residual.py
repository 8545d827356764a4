"""The residual of model, recording, noise and free parameters, in units of its standard deviation."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from estimators.core.data import CHANNELS, Data, Outputs3
from estimators.core.parameter_space import Physical, Space, Unknowns
from rtac_jax import RTAC, Excitation
from rtac_jax.equations import state_at_start
from rtac_jax.programs.arrays import to_jax
from rtac_jax.simulation import Steps, trajectories


def states_at_start(model: RTAC, start: Array, excitation: Excitation) -> tuple[Any, ...]:
    """Return the model's whole state from its estimated part: the rigid body's, and effects' offsets from equilibrium."""
    state = list(state_at_start(model, tuple(start[:4]), excitation.first_current()))
    row, place = 4, 4
    for effect in model.effects:
        for _ in effect.states:
            if effect.free_start:
                state[place] = state[place] + start[row]
                row += 1
            place += 1
    return tuple(state)


def start_rows(model: RTAC) -> tuple[str, ...]:
    """Return the names of the states at the start that a fit estimates."""
    names = tuple(model.states)
    return names[:4] + tuple(
        f"{effect.id}.{state}" for effect in model.effects if effect.free_start for state in effect.states
    )


def predict(
    model: RTAC,
    data: Data,
    space: Space,
    physical: Physical,
    *,
    substeps: Steps,
    gain: Array | None = None,
    impulses: Array | None = None,
) -> Outputs3:
    """Return the outputs of the model with these parameters, simulated or, with a gain, predicted one sample ahead.

    Impulses strike what is simulated; see `trajectories`.
    """
    shared, each, start = physical
    values: Mapping[str, Any] = dict(zip(space.names, shared, strict=True)) | dict(zip(space.each, each, strict=True))
    placed = model.with_values(values)
    return trajectories(
        placed,
        states_at_start(placed, start, data.excitation),
        data.excitation,
        room=data.room,
        samples=data.length,
        substeps=substeps,
        measured=None if gain is None else (data.values, data.present),
        gain=gain,
        impulses=impulses,
    )


def whitened(whitener: Array, error: Array) -> Array:
    """Return the error in units of its standard deviation: whitener [sample or 1, row, output, experiment] times error."""
    return sum(whitener[:, :, j] * error[:, None, j] for j in range(error.shape[1]))  # type: ignore[return-value] - sum begins with 0


def residual(
    model: RTAC,
    data: Data,
    space: Space,
    unknowns: Unknowns,
    whitener: Array,
    *,
    substeps: Steps,
    gain: Array | None = None,
) -> tuple[Outputs3, Float[Array, "start experiment"]]:
    """Return the residual: whitened output errors, and the starts' deviation from what is known of them."""
    physical = space.physical(unknowns)
    error = output_residual(model, data, space, physical, whitener, substeps=substeps, gain=gain)
    return error, _start_residual(space, unknowns, physical[2])


def output_residual(
    model: RTAC,
    data: Data,
    space: Space,
    physical: Physical,
    whitener: Array,
    *,
    substeps: Steps,
    gain: Array | None = None,
) -> Outputs3:
    """Return the whitened errors of the outputs alone; see `residual`."""
    error = (data.values - predict(model, data, space, physical, substeps=substeps, gain=gain)) * data.present
    return whitened(whitener, error)


def _start_residual(space: Space, unknowns: Unknowns, start: Array) -> Float[Array, "start experiment"]:
    """Return the starts' deviation from what is known of them, in units of its standard deviation."""
    if unknowns.start.shape[0] == 0:
        return unknowns.start
    return jnp.where(space.start_held > 0, unknowns.start, (start - space.start) / space.start_spread)


def prior_residual(
    space: Space, unknowns: Unknowns, physical: Physical, experiments: int
) -> Float[Array, "row experiment"]:
    """Return the deviation from what was known beforehand, in units of its standard deviation: starts, then constants.

    What was measured of constants belongs to no experiment: an equal part of it is counted with each.
    """
    of_start = _start_residual(space, unknowns, physical[2])
    if space.known is None:
        return of_start
    constants = space.from_known(physical[0]) / np.sqrt(experiments)
    return jnp.concatenate([of_start, jnp.broadcast_to(constants[:, None], (len(constants), experiments))])


def triangle(
    model: RTAC,
    data: Data,
    space: Space,
    unknowns: Unknowns,
    whitener: Array,
    *,
    substeps: Steps,
    gain: Array | None = None,
) -> tuple[Float[Array, "experiment output row column"], Float[Array, "experiment known column"]]:
    """Compress residual and Jacobian of each experiment and channel without loss to the triangular factor of [J, r].

    Its columns are the shared unknowns, the experiment's own, its start, and last the residual. Sums of squares, gradients
    and Gauss-Newton matrices are those of the whole residual. Because experiments do not depend on each other's unknowns, one
    direction serves the same unknown of all experiments, and the cost does not grow with their number. The rows of what was
    known beforehand stand apart, for whoever weighs channels anew.
    """
    count, width = data.experiments, [len(unknowns.shared), len(unknowns.each), len(unknowns.start)]
    directions = sum(width)

    def basis(block: int, like: Array) -> Array:
        first = sum(width[:block])
        rows = jnp.eye(directions)[:, first : first + width[block]]
        return rows if like.ndim == 1 else jnp.broadcast_to(rows[:, :, None], (directions, *like.shape))

    tangents = Unknowns(*(basis(block, leaf) for block, leaf in enumerate(unknowns)))

    def rows_of(at: Unknowns) -> tuple[Array, Array]:
        physical = space.physical(at)
        error = output_residual(model, data, space, physical, whitener, substeps=substeps, gain=gain)
        return error, prior_residual(space, at, physical, count)

    def along(tangent: Unknowns) -> Any:
        return jax.jvp(rows_of, (unknowns,), (tangent,))

    (error, known), (d_error, d_known) = jax.vmap(along, out_axes=(None, -1))(tangents)
    columns = jnp.concatenate([d_error, error[..., None]], axis=-1)
    outputs = columns.shape[1]
    rows = jnp.moveaxis(columns, 0, 2).swapaxes(0, 1).reshape(count * outputs, -1, directions + 1)
    prior = jnp.moveaxis(jnp.concatenate([d_known, known[..., None]], axis=-1), 1, 0)
    return signed(triangular(rows)).reshape(count, outputs, directions + 1, directions + 1), prior


def signed(factor: Float[Array, "block row column"]) -> Float[Array, "block row column"]:
    """Return triangular factors with a positive diagonal, which makes them continuous functions of the unknowns."""
    sign = jnp.where(jnp.diagonal(factor, axis1=1, axis2=2) < 0, -1.0, 1.0)
    return factor * sign[:, :, None]


def triangular(rows: Float[Array, "experiment row column"]) -> Float[Array, "experiment column column"]:
    """Return the triangular factor of each block, computed block by block.

    LAPACK on a tall matrix starts threads that fight for cores.
    """
    count, _, width = rows.shape
    height = max(256, 4 * width)
    while rows.shape[1] > 2 * height:
        parts = -(-rows.shape[1] // height)
        rows = jnp.pad(rows, ((0, 0), (0, parts * height - rows.shape[1]), (0, 0)))
        rows = _each_r(rows.reshape(count * parts, height, width)).reshape(count, parts * width, width)
    rows = jnp.pad(rows, ((0, 0), (0, max(0, width - rows.shape[1])), (0, 0)))
    return _each_r(rows)


def _each_r(rows: Float[Array, "block row column"]) -> Float[Array, "block column column"]:
    """Return the triangular factors of blocks, computed one after the other.

    A batch waits within XLA's threads for others of these. Two threads that factor batches at the same time would wait
    for each other for ever.
    """

    def of_one(block: Array) -> Array:
        return jnp.linalg.qr(block, mode="r")

    return jax.lax.map(of_one, rows)


def no_gain(model: RTAC, data: Data) -> Array:
    """Return the gain of a predictor that does not correct: a free simulation."""
    return to_jax(np.zeros((data.room, len(model.states), len(CHANNELS), data.experiments)))


def diagonal_whitener(deviation: np.ndarray, data: Data) -> Array:
    """Return the whitener that divides each output by its standard deviation; [1 row output experiment]."""
    inverse = np.diag(1.0 / np.asarray(deviation))[None, :, :, None]
    return to_jax(np.broadcast_to(inverse, (1, len(CHANNELS), len(CHANNELS), data.experiments)))
