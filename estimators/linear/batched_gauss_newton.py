"""Damped Gauss-Newton for many small least-squares problems of one shape at once.

optimistix's LevenbergMarquardt runs under vmap and ends in the same places, but damps all unknowns alike and lowers the damping
by a fixed factor, so that it takes three to eight times as many steps here, each with an orthogonal factorisation of every
Jacobian. Problems of ten unknowns that are scaled by their sensitivity are solved by their normal equations instead.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

_FIRST, _LEAST, _MOST = 1e-3, 1e-11, 1e12  # damping, relative to the sensitivities
_EXACT = 1e-15  # predicted decrease relative to the cost
_ENOUGH = 1e-4  # in a log-likelihood: no unknown would move by a fiftieth of its standard deviation
_PATIENCE = 25  # steps after which enough is enough, as where unknowns trade against each other


class Point(NamedTuple):
    """Cost, gradient and Gauss-Newton matrix at the unknowns."""

    theta: Float[Array, " unknown"]
    cost: Float[Array, ""]
    gradient: Float[Array, " unknown"]
    matrix: Float[Array, "unknown unknown"]


class _State(NamedTuple):
    point: Point
    damping: Float[Array, ""]
    steps: Int[Array, ""]
    done: Bool[Array, ""]
    converged: Bool[Array, ""]


def gauss_newton(
    residual: Callable[[Array], Array], theta: Float[Array, " unknown"], *, most: int | Int[Array, ""] = 60
) -> tuple[Point, Bool[Array, ""]]:
    """Minimise half the sum of squares; return the last point and whether it converged. Made to be vmapped.

    Args:
        residual: of the unknowns, in units of its standard deviation.
        theta: the unknowns at the start.
        most: number of steps at most.

    Source: Nocedal and Wright, Numerical Optimization (2006), section 10.3; Marquardt's scaling.
    """

    def at(where: Array) -> Point:
        jacobian, error = jax.jacfwd(lambda t: (residual(t),) * 2, has_aux=True)(where)
        return Point(where, 0.5 * jnp.sum(error**2), jacobian.T @ error, jacobian.T @ jacobian)

    def step(state: _State) -> _State:
        here = state.point
        scale = jnp.sqrt(jnp.maximum(jnp.diagonal(here.matrix), 1e-300))
        matrix = here.matrix / scale[:, None] / scale + state.damping * jnp.eye(len(theta))
        gradient = here.gradient / scale
        move = -jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(matrix), True), gradient)
        # An unknown without any effect stays where it is.
        move = jnp.where(scale > 1e-140, move, 0.0)
        predicted = -0.5 * (gradient @ move - state.damping * move @ move)
        there = at(here.theta + move / scale)
        sound = jnp.isfinite(there.cost) & jnp.all(jnp.isfinite(there.matrix)) & jnp.all(jnp.isfinite(move))
        better = sound & (there.cost <= here.cost * (1 + 1e-14))
        ratio = (here.cost - there.cost) / predicted
        less = jnp.where(ratio > 0.75, 0.1, jnp.where(ratio < 0.25, 4.0, 0.5))
        damping = jnp.clip(state.damping * jnp.where(better, less, 8.0), _LEAST, _MOST)
        small = predicted <= _EXACT * here.cost
        # Rounding alone can make the last step look worse.
        exact = small & (better | (jnp.abs(there.cost - here.cost) <= 1e-11 * here.cost))
        converged = exact | (better & (state.steps >= _PATIENCE) & (predicted < _ENOUGH))
        after = _State(
            jax.tree.map(lambda new, old: jnp.where(better, new, old), there, here),
            damping, state.steps + 1, converged | (damping >= _MOST), converged,
        )  # fmt: skip
        return jax.tree.map(lambda new, old: jnp.where(state.done, old, new), after, state)

    def running(state: _State) -> Array:
        return ~state.done & (state.steps < most)

    false = jnp.asarray(False)
    begin = _State(at(theta), jnp.asarray(_FIRST), jnp.asarray(0), false, false)
    ended = jax.lax.while_loop(running, step, begin)
    return ended.point, ended.converged
