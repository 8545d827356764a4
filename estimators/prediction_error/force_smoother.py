"""The Kalman filter and smoother of two unknown forces beside a predictor's state, along the motion that it foretells."""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from estimators.core.data import Data
from estimators.core.parameter_space import Physical, Space
from estimators.core.residual import states_at_start
from estimators.prediction_error.ekf import Wander, start_places, wandering
from rtac_jax import RTAC
from rtac_jax.equations import delivered, sensor_outputs
from rtac_jax.programs import program
from rtac_jax.simulation import Steps, advance, trajectories, unit_pushes
from rtac_jax.time_loop import time_loop

Kept = TypeVar("Kept")

_ABREAST = 16  # experiments, each with a force of its own size, that are filtered at once: more at once take longer


class LinearPath(eqx.Module):
    """The model linearised along the predicted motion: arrays with sample first and experiment last."""

    transition: Float[Array, "sample state state experiment"]
    push: Float[Array, "sample state port experiment"]
    shown: Float[Array, "sample output state experiment"]
    error: Float[Array, "sample output experiment"]
    wander: Wander
    begin: Float[Array, "state experiment"]
    interval: Float[Array, " experiment"]


@program
def linearised(
    model: RTAC,
    data: Data,
    space: Space,
    physical: Physical,
    gain: Array,
    variance: Array,
    start_variance: Array,
    substeps: Steps,
) -> LinearPath:
    """Linearise a model along the motion that its predictor foretells, with what a force at each port does to it.

    Args:
        model: without the forces.
        data: of all experiments.
        space: of the model's parameters.
        physical: parameters and starts of the predictor with this gain.
        gain: of the predictor, [sample state output experiment].
        variance: of each output's noise, SI units squared, [output experiment].
        start_variance: of the states at the start, [start experiment].
        substeps: of the integrator in each sample.
    """
    shared, each, start = physical
    placed = model.with_values(dict(zip(space.names, shared, strict=True)) | dict(zip(space.each, each, strict=True)))
    excitation = delivered(placed, data.excitation)
    predicted = trajectories(
        placed, states_at_start(placed, start, data.excitation), data.excitation, room=data.room, samples=data.length,
        substeps=substeps,
        measured=(data.values, data.present), gain=gain, states=True,
    )  # fmt: skip
    count, shape = predicted.shape[1], predicted[:, 0].shape

    def outputs(*state: Array) -> Array:
        return jnp.stack([jnp.broadcast_to(y, shape) for y in sensor_outputs(placed, state)])

    state = tuple(predicted[:, i] for i in range(count))
    error = (data.values - jnp.moveaxis(outputs(*state), 0, 1)) * data.present
    corrected = tuple(x + jnp.sum(gain[:, i] * error, axis=1) for i, x in enumerate(state))
    inputs = [
        None if known is None else tuple(known[:, p] for p in range(known.shape[1]))
        for known in (excitation.current, excitation.force)
    ]

    def onward(*at: Array) -> Array:
        return jnp.stack(advance(placed, at, inputs[0], inputs[1], excitation, substeps=substeps))

    def by_state(function: Callable[..., Array], at: tuple[Array, ...]) -> Array:
        """Return derivatives [sample row state experiment]; one map over directions, or each would be compiled by itself."""
        unit = tuple(jnp.broadcast_to(row[:, None, None], (count, *shape)) for row in jnp.eye(count))
        slopes = jax.vmap(lambda *along: jax.jvp(function, at, along)[1])(*unit)
        return jnp.transpose(slopes, (2, 1, 0, 3))

    transition, shown = by_state(onward, corrected), by_state(outputs, state)
    push = jnp.transpose(jnp.stack(unit_pushes(placed, corrected, excitation), axis=1), (2, 0, 1, 3))
    push = 0.5 * excitation.sample_time * (push + jnp.einsum("sabe,sbpe->sape", transition, push))
    wander = wandering(placed, variance, excitation.sample_time)
    begin = wander.stationary.at[jnp.asarray(start_places(model))].add(start_variance)
    return LinearPath(transition, push, shown, error, wander, begin, excitation.sample_time)


class _Update(NamedTuple):
    """The update by one output at one sample.

    Attributes:
        shows: what the output shows of the states.
        gain: of the filter.
        weight: reciprocal variance of the prediction; zero where nothing was measured.
        off: by which the prediction misses the output.
    """

    shows: Array
    gain: Array
    weight: Array
    off: Array


class _Filtered(NamedTuple):
    """The states and covariances of a filter at every sample, with what a smoother needs to go back.

    Attributes:
        mean, spread: of the states after all outputs of the sample.
        forward: transition to the next sample.
        updates: by each output.
        lasts: whether the experiment has a next sample.
        likelihood: logarithm of it, of the outputs that count.
    """

    mean: Array
    spread: Array
    forward: Array
    updates: tuple[_Update, ...]
    lasts: Array
    likelihood: Array


def _filter(
    linear: LinearPath,
    data: Data,
    gain: Array,
    size: Array,
    correlation_time: Float[Array, ""],
    swing: Float[Array, ""],
    keep_of: Callable[[_Filtered], Kept],
) -> Kept:
    """Filter the prediction errors with the two forces as further states, and return of every sample what is kept.

    A force is the real part of a phasor that turns at `swing` [rad/s] and forgets within `correlation_time` [s].
    """
    count, experiments = linear.transition.shape[1], linear.error.shape[2]
    keep = jnp.exp(-linear.interval / correlation_time)
    turn = keep * jnp.array([[jnp.cos(swing * linear.interval), -jnp.sin(swing * linear.interval)],
                             [jnp.sin(swing * linear.interval), jnp.cos(swing * linear.interval)]])  # fmt: skip
    unmoved, still = jnp.zeros((2, count, experiments)), jnp.zeros((2, 2, experiments))
    onward = jnp.concatenate(
        [jnp.concatenate([unmoved, turn, still], axis=1), jnp.concatenate([unmoved, still, turn], axis=1)]
    )
    whole, variance = count + 4, linear.wander.white
    power = jnp.broadcast_to(jnp.stack([size[0], size[0], size[1], size[1]])[:, None] ** 2, (4, experiments))
    unit = jnp.eye(whole)[:, :, None]
    fresh = unit * jnp.concatenate([linear.wander.fresh, (1 - keep**2) * power])
    spread = unit * jnp.concatenate([linear.begin, power])

    def one(carry: tuple[Array, Array], row: tuple[Array, ...]) -> tuple[tuple[Array, Array], Kept]:
        mean, spread = carry
        transition, push, shown, error, present, trusted, correction, lasts = row
        before = (mean, spread)
        likelihood = jnp.zeros(experiments)
        updates = []
        for j in range(len(variance)):
            h = jnp.concatenate([shown[j], jnp.zeros((4, experiments))])
            ph = jnp.sum(spread * h[None], axis=1)
            s = jnp.sum(h * ph, axis=0) + variance[j]
            off = error[j] - jnp.sum(h * mean, axis=0)
            k = present[j] * ph / s
            mean, spread = mean + k * off, spread - k[:, None] * ph[None]
            likelihood = likelihood - 0.5 * present[j] * (off**2 / s + jnp.log(s))
            updates.append(_Update(h, k, present[j] / s, off))
        moved = jnp.sum(correction * error[None], axis=1)
        nothing = jnp.zeros((count, experiments))
        pushes = jnp.stack([push[:, 0], nothing, push[:, 1], nothing], axis=1)
        forward = jnp.concatenate([jnp.concatenate([transition, pushes], axis=1), onward])
        known = mean.at[:count].add(-moved)
        after = jnp.sum(forward * known[None], axis=1)
        half = jnp.einsum("abe,bce->ace", forward, spread)
        grown = jnp.einsum("abe,cbe->ace", half, forward) + fresh
        onward_to = (after, 0.5 * (grown + jnp.swapaxes(grown, 0, 1)))
        carry = jax.tree.map(lambda new, held: jnp.where(lasts, new, held), onward_to, before)
        return carry, keep_of(_Filtered(mean, spread, forward, tuple(updates), lasts, trusted * likelihood))

    lasts = data.excitation.lasts(data.room)
    rows = (linear.transition, linear.push, linear.shown, linear.error, data.present, data.trusted, gain, lasts)
    start = jnp.zeros((whole, experiments))
    return time_loop(one, (start, spread), rows, room=data.room, samples=data.length)[1]


@program
def likelihoods(
    linear: LinearPath,
    data: Data,
    gain: Array,
    sizes: Array,
    correlation_time: Float[Array, ""],
    swing: Float[Array, ""],
) -> Array:
    """Return the log-likelihood of all outputs for each pair of sizes of the two forces, [trial port]."""
    return jax.lax.map(
        lambda size: _filter(linear, data, gain, size, correlation_time, swing, lambda row: row.likelihood).sum(),
        sizes, batch_size=max(1, _ABREAST // linear.error.shape[2]),
    )  # fmt: skip


@program
def smoothed(
    linear: LinearPath,
    data: Data,
    gain: Array,
    size: Array,
    correlation_time: Float[Array, ""],
    swing: Float[Array, ""],
) -> tuple[Array, Array]:
    """Return mean and variance of the two forces, [sample port experiment].

    By the slope and the curvature of the likelihood of all later outputs (Bryson and Frazier), which inverts no covariance: a force
    that is all but nothing has one that is singular.
    """
    found = _filter(linear, data, gain, size, correlation_time, swing, lambda row: row)

    def one(later: tuple[Array, Array], row: _Filtered) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        slope, curvature = (jnp.where(row.lasts, x, 0.0) for x in later)
        slope = jnp.sum(row.forward * slope[:, None], axis=0)
        curvature = jnp.einsum("bae,bce->ace", row.forward, jnp.einsum("bce,cde->bde", curvature, row.forward))
        mean = row.mean - jnp.sum(row.spread * slope[None], axis=1)
        half = jnp.einsum("abe,bce->ace", row.spread, curvature)
        variance = jnp.einsum("aae->ae", row.spread) - jnp.sum(half * row.spread, axis=1)
        for update in reversed(row.updates):
            slope = slope - update.shows * (update.weight * update.off + jnp.sum(update.gain * slope, axis=0))
            turned = jnp.sum(curvature * update.gain[None], axis=1)
            both = update.shows[:, None] * turned[None]
            own = update.weight + jnp.sum(update.gain * turned, axis=0)
            curvature = curvature - both - jnp.swapaxes(both, 0, 1)
            curvature = curvature + own * update.shows[:, None] * update.shows[None]
        return (slope, curvature), (mean[-4::2], variance[-4::2])

    nothing = jnp.zeros_like(found.mean[0]), jnp.zeros_like(found.spread[0])
    backwards = jax.tree.map(lambda x: x[::-1], found)
    mean, variance = time_loop(one, nothing, backwards, room=data.room, samples=data.room)[1]
    return mean[::-1], variance[::-1]
