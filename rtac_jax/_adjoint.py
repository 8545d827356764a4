"""The states of a simulation with derivatives in both directions, whatever the number of its samples and steps.

A loop whose length the compiler does not know has no reverse derivative of its own. Here the tangents of the states follow a
linear loop of their own along the states that the simulation has passed, and the transpose of that loop runs backwards over
the same states: it keeps one state for each sample, and takes the steps between two samples anew.
"""

from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.interpreters.ad as ad
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rtac_jax._rtac import RTAC
from rtac_jax.effects import Input
from rtac_jax.equations import delivered
from rtac_jax.excitation import Excitation
from rtac_jax.programs import program
from rtac_jax.simulation import runge_kutta, trajectories, without_denormals
from rtac_jax.time_loop import time_loop


class Driven(eqx.Module):
    """The quantities on which the states depend, or a direction in which these change, where None does not change.

    Attributes:
        model: without effects on its inputs, which have acted already.
        start: states at the start.
        current, force: polynomials of the inputs, as in `Excitation`.
        frame: the excitation without them: sample times, and what is held.
    """

    model: RTAC
    start: Float[Array, "state experiment"] | None
    current: Float[Array, "sample current_power experiment"] | None
    force: Float[Array, "sample force_power experiment"] | None
    frame: Excitation


@program
def differentiable_states(
    model: RTAC,
    start: Float[Array, "state experiment"],
    excitation: Excitation,
    room: int,
    samples: Int[Array, ""],
    substeps: Int[Array, ""],
    most: int,
) -> Float[Array, "sample state experiment"]:
    """Return the states that `trajectories` returns, differentiable forwards and backwards.

    Second derivatives are forward ones, `jax.jacfwd` of either.

    Args:
        model: at the values by which to differentiate.
        start: every state at the first sample, SI units.
        excitation: the inputs.
        room: length of the arrays.
        samples: how many of them are run through.
        substeps: Runge-Kutta steps per sample.
        most: the largest number of them for which there is room.
    """
    driven = delivered(model, excitation)
    bare = model.without(*(effect.id for effect in model.effects if isinstance(effect, Input)))
    frame = Excitation(None, None, driven.sample_time, driven.arm_free, driven.cart_free)
    return _states(Driven(bare, start, driven.current, driven.force, frame), samples, substeps, room=room, most=most)


@eqx.filter_custom_jvp
def _states(driven: Driven, samples: Array, substeps: Array, *, room: int, most: int) -> Array:
    frame, start = driven.frame, driven.start
    assert start is not None
    excitation = Excitation(driven.current, driven.force, frame.sample_time, frame.arm_free, frame.cart_free)
    # It may be one of a batch by `jax.vmap`.
    return trajectories(
        driven.model,
        tuple(start),
        excitation,
        room=room,
        samples=samples,
        substeps=substeps,
        states=True,
        unrolled=True,
    )


@_states.def_jvp
def _states_jvp(
    primals: tuple[Driven, Array, Array], tangents: tuple[Any, ...], *, room: int, most: int
) -> tuple[Array, Array]:
    driven, samples, substeps = primals
    path = _states(driven, samples, substeps, room=room, most=most)
    return path, eqxi.filter_primitive_bind(_tangents_p, tangents[0], driven, path, samples, substeps, most)


def _onward(
    model: RTAC,
    state: Array,
    current: Array | None,
    force: Array | None,
    frame: Excitation,
    begin: Array,
    substeps: Array,
) -> Array:
    """Take one Runge-Kutta step, with the states as one array."""
    now, push = (None if x is None else tuple(x) for x in (current, force))
    step = frame.sample_time / substeps
    after = runge_kutta(model, tuple(state), now, push, frame, step=step, begin=begin, substeps=substeps)
    return jnp.stack([jnp.broadcast_to(x, state.shape[1:]) for x in after])


def _tangents(direction: Driven, driven: Driven, path: Array, samples: Array, substeps: Array, most: int) -> Array:
    """Change of the states along a direction of what they depend on; None in it does not change."""

    def one_sample(change: Array, row: Any) -> tuple[Array, Array]:
        at, powers, d_powers = row

        def one_step(k: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
            state, change = carry
            return eqx.filter_jvp(
                lambda model, state, powers, frame: _onward(
                    model, state, powers[0], powers[1], frame, k / substeps, substeps
                ),
                (driven.model, state, powers, driven.frame),
                (direction.model, change, d_powers, direction.frame),
            )

        _, after = jax.lax.fori_loop(0, substeps, one_step, (at, change))
        return without_denormals(after), change

    first = jnp.zeros_like(path[0]) if direction.start is None else direction.start
    rows = (path, (driven.current, driven.force), (direction.current, direction.force))
    return time_loop(one_sample, first, rows, room=path.shape[0], samples=samples)[1]


def _gradients(
    wanted: Driven, driven: Driven, path: Array, weights: Array, samples: Array, substeps: Array, most: int
) -> Driven:
    """Return gradients of the sum of the states times weights, by the transpose of `_tangents`.

    Args:
        wanted: True where a gradient is asked for; elsewhere it is None.
        driven: what the states depend on.
        path: the states at every sample.
        weights: of every state at every sample.
        samples: how many are run through.
        substeps: Runge-Kutta steps per sample.
        most: steps between two samples for whose states there is room.
    """
    signals = eqx.filter((driven.current, driven.force), (wanted.current, wanted.force))
    still = eqx.filter((driven.model, driven.frame), (wanted.model, wanted.frame))

    def pulled(k: Array, weight: Array) -> tuple[Array, Any, Any]:
        """Weights of the state at sample k, and gradients of what acts between it and the next, from the weights there."""
        powers = jax.tree.map(lambda x: x[k], (driven.current, driven.force))
        some_powers = jax.tree.map(lambda x: x[k], signals)

        def step(state: Array, still: Any, some_powers: Any, j: Array) -> Array:
            model, frame = eqx.combine(still, (driven.model, driven.frame))
            current, force = eqx.combine(some_powers, powers)
            return _onward(model, state, current, force, frame, j / substeps, substeps)

        def ahead(j: Array, passed: Array) -> Array:
            return passed.at[j + 1].set(step(passed[j], still, some_powers, j))

        passed = jnp.zeros((most, *path.shape[1:]), path.dtype).at[0].set(path[k])
        passed = jax.lax.fori_loop(0, substeps - 1, ahead, passed)

        def back(i: Array, carry: tuple[Array, Any, Any]) -> tuple[Array, Any, Any]:
            weight, *gradients = carry
            j = substeps - 1 - i
            _, pull = jax.vjp(lambda at, still, powers: step(at, still, powers, j), passed[j], still, some_powers)
            weight, *more = pull(weight)
            return weight, *jax.tree.map(jnp.add, tuple(gradients), tuple(more))

        zeros = jax.tree.map(jnp.zeros_like, (still, some_powers))
        return jax.lax.fori_loop(0, substeps, back, (without_denormals(weight), *zeros))

    def one_sample(i: Array, carry: tuple[Array, Any, Any]) -> tuple[Array, Any, Any]:
        weight, of_still, of_signals = carry
        k = samples - 2 - i
        weight, more, of_powers = pulled(k, weight)
        of_signals = jax.tree.map(lambda rows, row: rows.at[k].set(row), of_signals, of_powers)
        return weight + weights[k], jax.tree.map(jnp.add, of_still, more), of_signals

    carry = (weights[samples - 1], *jax.tree.map(jnp.zeros_like, (still, signals)))
    weight, (of_model, of_frame), (of_current, of_force) = jax.lax.fori_loop(0, samples - 1, one_sample, carry)
    return Driven(of_model, weight if wanted.start else None, of_current, of_force, of_frame)


def _tangents_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
    d_direction, *d_known = tangents
    value = eqxi.filter_primitive_bind(_tangents_p, *primals)
    if not jax.tree.leaves(d_known):
        return value, eqxi.filter_primitive_bind(_tangents_p, d_direction, *primals[1:])
    return eqx.filter_jvp(_tangents, primals, tangents)


def _tangents_transpose(primals: tuple[Any, ...], weights: Array) -> tuple[Any, ...]:
    direction, driven, path, samples, substeps, most = primals
    wanted = jax.tree.map(lambda x, _: _is_linear(x), direction, driven, is_leaf=lambda x: x is None or _is_linear(x))
    gradients = _gradients(wanted, driven, path, weights, samples, substeps, most)
    return gradients, *jax.tree.map(lambda _: None, (driven, path, samples, substeps, most))


def _is_linear(x: object) -> bool:
    return isinstance(x, ad.UndefinedPrimal)


_tangents_p = eqxi.create_vprim(
    "simulation_tangents",
    eqxi.filter_primitive_def(_tangents),
    eqxi.filter_primitive_def(lambda direction, driven, path, *_: path),
    eqxi.filter_primitive_jvp(_tangents_jvp),
    eqxi.filter_primitive_transpose(materialise_zeros=True)(_tangents_transpose),
)
