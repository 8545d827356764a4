"""The triangular factor of long experiments: their pieces side by side, a few at a time, so that memory stays bounded.

A sensitivity of what is simulated is linear in the sensitivity of the state where a piece begins. So every piece is
differentiated by its own first state and by the parameters, all pieces side by side, and the chain rule puts them together.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from estimators.core.data import Data
from estimators.core.parameter_space import Space, Unknowns
from estimators.core.residual import prior_residual, signed, states_at_start, triangular, whitened
from rtac_jax import RTAC, Excitation
from rtac_jax.effects import Input
from rtac_jax.equations import sensor_outputs
from rtac_jax.simulation import Steps, trajectories

PIECE, LEAST_PIECE = 256, 64
"""Samples of a piece: many more than there are states, so that the work by its first state is no burden; fewer where the
experiments themselves are many."""
SIDE_BY_SIDE = 1 << 15
"""Samples of all pieces that are differentiated at a time; with 12 directions and 3 outputs they take some 50 MB."""
LONG = 1 << 14
"""Room of an experiment from which it is long: worth cutting, and a program of its own for what skips work; 16 s at 1 kHz."""
MANY = 1 << 18
"""Samples of all experiments from which they are cut however short they are: whole, their sensitivities take 0.5 GB."""


def worth_cutting(model: RTAC, data: Data) -> bool:
    """Return whether a factor should be computed by pieces; effects that look along a whole input cannot be cut."""
    looks_ahead = any(isinstance(effect, Input) for effect in model.effects)
    return not looks_ahead and (data.room >= LONG or data.room * data.experiments >= MANY)


def piecewise_triangle(
    model: RTAC,
    data: Data,
    space: Space,
    unknowns: Unknowns,
    whitener: Array,
    *,
    substeps: Steps,
    gain: Array | None = None,
) -> tuple[Float[Array, "experiment output row column"], Float[Array, "experiment known column"]]:
    """Compress residual and Jacobian of each experiment and channel as `triangle` does, which gives the same numbers.

    Args:
        model: that is simulated; without effects that look along a whole input.
        data: what was measured.
        space: of the unknowns.
        unknowns: at which to compute.
        whitener: [sample or 1, row, output, experiment].
        substeps: Runge-Kutta steps per sample.
        gain: of a prediction; None for a simulation.
    """
    many, states, outputs = data.experiments, len(model.states), data.values.shape[1]
    size = min(PIECE, max(LEAST_PIECE, SIDE_BY_SIDE // many))
    pieces = max(1, SIDE_BY_SIDE // (size * many))
    stretch = pieces * size
    own, every = len(unknowns.shared) + len(unknowns.each), sum(len(leaf) for leaf in unknowns)
    directions = _identity(unknowns)

    def placed(shared: Array, each: Array, times: int) -> RTAC:
        """Return the model with physical parameters for as many copies of the experiments."""
        values = dict(zip(space.names, shared, strict=True))
        return model.with_values(values | dict(zip(space.each, jnp.tile(each, (1, times)), strict=True)))

    def physical(at: Unknowns) -> tuple[Array, Array, Array, Array]:
        """Return the physical parameters, the first states, and the deviation from what was known beforehand."""
        all_of_them = shared, each, start = space.physical(at)
        found = states_at_start(placed(shared, each, 1), start, data.excitation)
        first = jnp.stack([jnp.broadcast_to(x, (many,)) for x in found])
        return shared, each, first, prior_residual(space, at, all_of_them, many)

    def physical_along(direction: Unknowns) -> tuple[Any, Any]:
        return jax.jvp(physical, (unknowns,), (direction,))

    # Once, before the loop: XLA for processors fails to compile what it draws out of the loop of this itself.
    (shared, each, state, known), (d_shared, d_each, d_state, d_known) = jax.lax.optimization_barrier(
        jax.vmap(physical_along, out_axes=(None, 0))(directions)
    )
    now = placed(shared, each, 1)

    def run(there: RTAC, state: Array, first: Array, times: int, length: int) -> tuple[Array, Array]:
        """Return the states of so many pieces from their first ones, and the whitened error without the last sample."""
        index = first + jnp.arange(length)[:, None] + size * jnp.arange(times)

        def cut(x: Array | None) -> Any:
            # What is beyond the arrays is masked below: an experiment that has ended holds its state.
            return None if x is None else _columns(x[jnp.minimum(index, data.room - 1)])

        samples = _left(data, first + size * jnp.arange(times))
        given = data.excitation
        sample_time, arm_free, cart_free = (
            jnp.tile(x, times) for x in (given.sample_time, given.arm_free, given.cart_free)
        )
        excitation = Excitation(cut(given.current), cut(given.force), sample_time, arm_free, cart_free, samples)
        within = jnp.arange(length)[:, None] < samples
        values, present = cut(data.values), cut(data.present) * within[:, None]
        path = trajectories(
            there, tuple(state), excitation, room=length, samples=length, substeps=substeps, states=True,
            measured=None if gain is None else (values, present), gain=cut(gain),
        )  # fmt: skip
        seen = sensor_outputs(there, tuple(jnp.moveaxis(path, 1, 0)))
        shown = jnp.stack([jnp.broadcast_to(y, path[:, 0].shape) for y in seen], axis=1)
        white = cut(whitener) if whitener.shape[0] > 1 else jnp.tile(whitener, (1, 1, 1, times))
        return path, whitened(white, (values - shown) * present)[:-1]

    def one_stretch(k: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        state, change, above = carry
        first = k * stretch
        path, _ = run(now, state, first, 1, stretch + 1)
        starts = jnp.moveaxis(path[:-1:size], 0, 1).reshape(states, pieces * many)

        def local(shared: Array, each: Array, at: Array) -> tuple[Array, Array]:
            there = placed(shared, each, pieces)
            ends, error = run(there, at, first, pieces, size + 1)
            return ends[-1], error

        def local_along(direction: tuple[Array, Array, Array]) -> tuple[Any, Any]:
            return jax.jvp(local, (shared, each, starts), direction)

        # Directions of a piece: the parameters, then its first state.
        by_state = jnp.broadcast_to(jnp.eye(own + states)[:, own:, None], (own + states, *starts.shape))
        tangents = (_padded(d_shared[:own], states), _padded(d_each[:own], states), by_state)
        (_, error), (d_end, d_error) = jax.vmap(local_along, out_axes=(None, -1))(tangents)
        rows = jnp.moveaxis(jnp.concatenate([d_error, error[..., None]], axis=-1), 0, 2).swapaxes(0, 1)
        # One block for each piece and channel, of its own directions, its first state and the error.
        local_factor = triangular(rows.reshape(pieces * many * outputs, -1, own + states + 1))
        local_factor = local_factor.reshape(pieces, many, outputs, *local_factor.shape[1:])
        d_end = jnp.moveaxis(d_end.reshape(states, pieces, many, own + states), 0, 2)

        def onward(change: Array, of_end: Array) -> tuple[Array, Array]:
            fresh = jnp.pad(of_end[..., :own], ((0, 0), (0, 0), (0, every - own)))
            return fresh + jnp.einsum("est,etd->esd", of_end[..., own:], change), change

        change, before = jax.lax.scan(onward, change, d_end)
        blocks = _by_unknowns(local_factor, before, own, every)
        blocks = jnp.moveaxis(blocks, 0, 2).reshape(many * outputs, -1, every + 1)
        return path[-1], change, triangular(jnp.concatenate([above, blocks], axis=1))

    prior = jnp.moveaxis(jnp.concatenate([jnp.moveaxis(d_known, 0, -1), known[..., None]], axis=-1), 1, 0)
    count = -(-data.length // stretch)
    nothing = jnp.zeros((many * outputs, every + 1, every + 1))
    carry = (state, jnp.moveaxis(d_state, (0, 2), (2, 0)), nothing)
    _, _, factor = jax.lax.fori_loop(0, count, one_stretch, carry)
    return signed(factor).reshape(many, outputs, every + 1, every + 1), prior


def _padded(tangents: Float[Array, "direction *rest"], more: int) -> Float[Array, "more_directions *rest"]:
    """Return tangents with as many directions more, along which nothing changes."""
    return jnp.concatenate([tangents, jnp.zeros((more, *tangents.shape[1:]))])


def _identity(unknowns: Unknowns) -> Unknowns:
    width = [len(leaf) for leaf in unknowns]
    rows = jnp.eye(sum(width))
    parts, first = [], 0
    for leaf, count in zip(unknowns, width, strict=True):
        part = rows[:, first : first + count]
        parts.append(part if leaf.ndim == 1 else jnp.broadcast_to(part[:, :, None], (len(rows), *leaf.shape)))
        first += count
    return Unknowns(*parts)


def _columns(x: Float[Array, "sample piece *rest"]) -> Float[Array, "sample *other"]:
    """Return what has a piece and, last, an experiment as axes with both as one."""
    x = jnp.moveaxis(x, 1, -2)
    return x.reshape(*x.shape[:-2], -1)


def _left(data: Data, begin: Int[Array, " piece"]) -> Int[Array, " column"]:
    """Return the samples that are left of each experiment where each piece begins, one piece after the other."""
    given = data.excitation.samples
    samples = jnp.full((data.experiments,), data.length) if given is None else jnp.minimum(given, data.length)
    return jnp.maximum(samples - begin[:, None], 0).reshape(-1)


def _by_unknowns(
    factor: Float[Array, "piece experiment output row column"],
    change: Float[Array, "piece experiment state direction"],
    own: int,
    every: int,
) -> Float[Array, "piece experiment output row unknown"]:
    """Return factors by a piece's own directions and first state as such by all unknowns, with the error last."""
    through_state = jnp.einsum("peors,pesd->peord", factor[..., own:-1], change)
    directly = jnp.pad(factor[..., :own], (*((0, 0),) * 4, (0, every - own)))
    return jnp.concatenate([through_state + directly, factor[..., -1:]], axis=-1)
