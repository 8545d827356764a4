"""Gauss-Newton's normal equations of many experiments, summed up in the time loop, so that no sensitivity is kept."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from estimators.core.bound_transform import to_physical
from estimators.core.data import Data
from estimators.core.residual import states_at_start
from rtac_jax import RTAC, Excitation
from rtac_jax.effects import Input
from rtac_jax.equations import delivered, sensor_outputs
from rtac_jax.excitation import Real
from rtac_jax.simulation import Steps, advance, without_denormals


class Columns(NamedTuple):
    """The bounds, scales and starts of the unknowns of each experiment.

    Attributes:
        lower, upper, scale: of the parameters, as in `to_physical`.
        start: expected states at the start, as in `Space`.
        start_scale, start_spread, start_held: likewise.
        known: values of the parameters that are not estimated.
    """

    lower: Float[Real, "parameter experiment"]
    upper: Float[Real, "parameter experiment"]
    scale: Float[Real, "parameter experiment"]
    start: Float[Real, "start experiment"]
    start_scale: Float[Real, "start experiment"]
    start_spread: Float[Real, "start experiment"]
    start_held: Float[Real, "start experiment"]
    known: Float[Real, "known experiment"]


def physical(
    columns: Columns, unknowns: Float[Array, "unknown experiment"]
) -> tuple[Float[Array, "parameter experiment"], Float[Array, "start experiment"]]:
    """Return parameters and states at the start in SI units; the parameters are the first of the unknowns."""
    count = len(columns.lower)
    values = to_physical(unknowns[:count], columns.lower, columns.upper, columns.scale)
    return values, columns.start + (1.0 - columns.start_held) * columns.start_scale * unknowns[count:]


def normal_equations(
    model: RTAC,
    names: Sequence[str],
    outputs: Sequence[int],
    data: Data,
    columns: Columns,
    unknowns: Float[Array, "unknown experiment"],
    *,
    substeps: Steps,
) -> Float[Array, "output column column experiment"]:
    """Return the products of Jacobian and error, [J, e]' [J, e], of each output of each experiment, SI units of the outputs.

    Every experiment has all parameters for itself, so one direction serves the same unknown of all experiments. What is not
    measured counts nothing. Where a model diverges the numbers are not finite.

    Args:
        model: that is simulated.
        names: of the parameters, which are the first unknowns; the states at the start follow.
        outputs: places of those that were measured.
        data: what was measured.
        columns: how the unknowns of each experiment are placed and scaled.
        unknowns: at which to compute.
        substeps: Runge-Kutta steps per sample.
    """
    shape = data.excitation.sample_time.shape
    many = len(unknowns)
    index = jnp.asarray(outputs)
    directions = jnp.broadcast_to(jnp.eye(many)[:, :, None], (many, many, *shape))

    def placed(at: Array) -> tuple[Array, RTAC]:
        values, start = physical(columns, at)
        return start, model.with_values(dict(zip(names, values, strict=True)))

    def beginning(at: Array) -> Array:
        start, there = placed(at)
        return _stacked(states_at_start(there, start, data.excitation), shape)

    def shown(values: Array, state: Array) -> Array:
        seen = sensor_outputs(model.with_values(dict(zip(names, values, strict=True))), tuple(state))
        return _stacked([seen[place] for place in outputs], shape)

    def signals(at: Array) -> tuple[Array | None, Array | None]:
        reaching = delivered(placed(at)[1], data.excitation)
        return reaching.current, reaching.force

    def onward(values: Array, state: Array, powers: tuple[Array | None, Array | None]) -> Array:
        there = model.with_values(dict(zip(names, values, strict=True)))
        there = there.without(*(effect.id for effect in there.effects if isinstance(effect, Input)))
        current, force = (None if x is None else tuple(x) for x in powers)
        after = advance(there, tuple(state), current, force, still, substeps=substeps)
        return jnp.stack([without_denormals(x) for x in after])

    given = data.excitation
    still = Excitation(None, None, given.sample_time, given.arm_free, given.cart_free)
    rows, d_rows = signals(unknowns), None
    if any(isinstance(effect, Input) for effect in model.effects):
        d_rows = jax.vmap(lambda along: jax.jvp(signals, (unknowns,), (along,))[1], out_axes=1)(directions)

    # From unknowns to physical values once, and not in every sample.
    values, moves = jax.vmap(
        lambda along: jax.jvp(lambda at: physical(columns, at)[0], (unknowns,), (along,)), out_axes=(None, 0)
    )(directions)

    def one_sample(k: Array, carry: tuple[Array, Array, tuple[Array, ...]]) -> tuple[Array, Array, tuple[Array, ...]]:
        state, change, products = carry
        value, slope = jax.vmap(lambda along, by: jax.jvp(shown, (values, state), (along, by)), out_axes=(None, 0))(
            moves, change
        )
        present = data.present[k][index]
        error = (data.values[k][index] - value) * present
        column = jnp.concatenate([-slope * present, error[None]])  # [column output experiment]
        column = jax.lax.optimization_barrier(jnp.moveaxis(column, 1, 0))
        products = tuple(p + column[:, n:] * column[:, n, None] for n, p in enumerate(products))
        here = jax.tree.map(lambda x: x[k], rows)
        d_here = jax.tree.map(jnp.zeros_like, here) if d_rows is None else jax.tree.map(lambda x: x[k], d_rows)
        axis = None if d_rows is None else 0
        state, change = jax.vmap(
            lambda along, by, push: jax.jvp(onward, (values, state, here), (along, by, push)),
            in_axes=(0, 0, axis),
            out_axes=(None, 0),
        )(moves, change, d_here)
        return state, change, products

    state, change = jax.vmap(lambda along: jax.jvp(beginning, (unknowns,), (along,)), out_axes=(None, 0))(directions)
    # The products are symmetric: of each row from the diagonal on.
    rows_of = tuple(jnp.zeros((len(outputs), many + 1 - n, *shape)) for n in range(many + 1))
    above = jax.lax.fori_loop(0, data.length, one_sample, (state, change, rows_of))[2]
    # Parts that are set within an array take the compiler as long as the simulation does.
    upper = jnp.stack([jnp.pad(row, ((0, 0), (n, 0), (0, 0))) for n, row in enumerate(above)], axis=1)
    place = jnp.arange(many + 1)
    return jnp.where((place[:, None] <= place)[:, :, None], upper, jnp.swapaxes(upper, 1, 2))


def _stacked(values: Sequence[Array | float], shape: tuple[int, ...]) -> Array:
    return jnp.stack([jnp.broadcast_to(x, shape) for x in values])
