"""Gains of an extended Kalman filter along all experiments at once, for a model with random force and torque."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from estimators._problem import Data, Space, states_at_start
from rtac_jax import RTAC, Excitation
from rtac_jax._simulate import Steps, advance


class Filtered(NamedTuple):
    """A pass of the filter.

    Attributes:
        gain: correction of the state by the prediction error at each sample.
        whitener: lower triangular; times the prediction error it is white with unit variance.
        innovations: prediction errors in units of their standard deviation.
        log_likelihood: of each experiment, less the constant.
    """

    gain: Float[Array, "sample state output experiment"]
    whitener: Float[Array, "sample output output experiment"]
    innovations: Float[Array, "sample output experiment"]
    log_likelihood: Float[Array, " experiment"]


def kalman(
    model: RTAC,
    data: Data,
    space: Space,
    physical: tuple[Array, Array, Array],
    *,
    sensor_variance: Float[Array, "output experiment"],
    process: tuple[Any, Any],
    start_variance: Float[Array, "start experiment"],
    substeps: Steps,
) -> Filtered:
    """Run the filter.

    Args:
        sensor_variance: of each output's noise, SI units squared.
        process: spectral densities of a random force on the cart [N^2 s] and of a random torque on the arm [(N m)^2 s].
        start_variance: of the states at the start.

    Source: Jazwinski, Stochastic Processes and Filtering Theory (1970), chapter 8.
    """
    shared, each, start = physical
    placed = model.with_values(dict(zip(space.names, shared, strict=True)) | dict(zip(space.each, each, strict=True)))
    excitation = data.excitation
    shape = excitation.sample_time.shape
    state = tuple(jnp.broadcast_to(x, shape) for x in states_at_start(placed, start, excitation))
    count = len(state)
    places = _start_places(model)
    spread = jnp.zeros((count, count, *shape))
    for row, place in enumerate(places):
        spread = spread.at[place, place].set(start_variance[row])
    unit = tuple(jnp.broadcast_to(row[:, None], (count, *shape)) for row in jnp.eye(count))

    def one_sample(carry: tuple[Any, Array], row: dict[str, Any]) -> tuple[tuple[Any, Array], Any]:
        state, spread = carry

        def shown(at: Any) -> tuple[Any, ...]:
            return tuple(jnp.broadcast_to(y, shape) for y in placed.outputs(at))

        outputs, slopes = _with_slopes(shown, state, unit)
        slopes = jax.lax.stop_gradient(slopes)
        gains, whitener, innovations = [], [], []
        likelihood = jnp.zeros(shape)
        # Outputs are uncorrelated given the state, so they are taken one after the other; the rows of the triangular
        # whitener and the joint gain follow by substitution.
        shift = [jnp.zeros(shape) for _ in range(count)]
        effect_of = [[jnp.zeros(shape) for _ in range(3)] for _ in range(count)]
        for j in range(3):
            there = row["present"][j]
            h = slopes[j]
            ph = [sum(spread[a, b] * h[b] for b in range(count)) for a in range(count)]
            variance = sum(h[a] * ph[a] for a in range(count)) + sensor_variance[j]
            k = [there * x / variance for x in ph]
            # innovation_j = e_j - h . (shift so far), linear in the errors e_0 .. e_j
            weights: list[Any] = [-sum(h[a] * effect_of[a][i] for a in range(count)) for i in range(3)]
            weights[j] = weights[j] + 1.0
            error = row["values"][j] - outputs[j] - sum(h[a] * shift[a] for a in range(count))
            error = error * there
            deviation = jnp.sqrt(variance)
            innovations.append(error / deviation)
            whitener.append([there * w * row["present"][i] / deviation for i, w in enumerate(weights)])
            likelihood = likelihood - 0.5 * there * (error**2 / variance + jnp.log(variance))
            shift = [s + x * error for s, x in zip(shift, k, strict=True)]
            effect_of = [
                [effect_of[a][i] + k[a] * weights[i] * row["present"][i] for i in range(3)] for a in range(count)
            ]
            kk, pp = jnp.stack(k), jnp.stack(ph)
            spread = spread - kk[:, None] * pp[None, :]
            spread = 0.5 * (spread + jnp.swapaxes(spread, 0, 1))
        gains = jnp.stack([jnp.stack(effect_of[a]) for a in range(count)])
        state = tuple(x + dx for x, dx in zip(state, shift, strict=True))

        current, force = (None if row[name] is None else tuple(row[name]) for name in ("current", "force"))

        def forward(at: Any) -> Any:
            return advance(placed, at, current, force, excitation, substeps=substeps)

        pushes = jax.lax.stop_gradient(_pushes(placed, state, excitation))
        # Derivatives by the noise go through the linearised step that the filter has anyway; those of the linearisation
        # itself would cost far more and matter far less.
        here = jax.lax.stop_gradient(state)
        there, jacobian = jax.lax.stop_gradient(_with_slopes(forward, here, unit))
        away = [x - x0 for x, x0 in zip(state, here, strict=True)]
        state = tuple(x + sum(line[b] * away[b] for b in range(count)) for x, line in zip(there, jacobian, strict=True))
        f = jnp.stack([jnp.stack(line) for line in jacobian])
        half = (
            0.5
            * excitation.sample_time
            * sum(density * push[:, None] * push[None, :] for density, push in zip(process, pushes, strict=True))
        )
        spread = _product(_product(f, spread + half), jnp.swapaxes(f, 0, 1)) + half
        return (state, spread), (gains, jnp.stack([jnp.stack(w) for w in whitener]), jnp.stack(innovations), likelihood)

    rows = {
        "current": excitation.current, "force": excitation.force, "values": data.values, "present": data.present
    }  # fmt: skip
    _, (gain, whitener, innovations, likelihood) = jax.lax.scan(one_sample, (state, spread), rows, length=data.samples)
    return Filtered(gain, whitener, innovations, likelihood.sum(axis=0))


filtered = eqx.filter_jit(kalman)


def _start_places(model: RTAC) -> tuple[int, ...]:
    places, place = [0, 1, 2, 3], 4
    for effect in model.effects:
        for _ in effect.states:
            if effect.free_start:
                places.append(place)
            place += 1
    return tuple(places)


def _with_slopes(function: Any, state: Any, unit: Any) -> tuple[Any, list[Any]]:
    """Value, and for each element of it the derivatives by every state."""
    value, slopes = jax.vmap(lambda t: jax.jvp(function, (state,), (t,)), out_axes=(None, 0))(unit)
    return tuple(value), [tuple(slope[i] for i in range(len(state))) for slope in slopes]


def _pushes(model: RTAC, state: Any, excitation: Excitation) -> tuple[Array, Array]:
    """What a unit force on the cart and a unit torque on the arm do to all states' rates."""
    cart_cart, cart_arm, arm_arm = model.pushes(state, excitation.arm_free, excitation.cart_free)
    zero = jnp.zeros_like(state[0])
    rest = [zero] * (len(state) - 4)
    return jnp.stack([zero, cart_cart, zero, cart_arm, *rest]), jnp.stack([zero, cart_arm, zero, arm_arm, *rest])


def _product(a: Array, b: Array) -> Array:
    return jnp.sum(a[:, :, None] * b[None, :, :], axis=1)
