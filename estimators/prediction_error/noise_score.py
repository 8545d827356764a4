"""Derivatives of a Kalman filter's likelihood by its noise, from the linear model along a pass of the filter.

The linearised model is taken as it is: its own change with the noise would cost far more and matters far less. What is here
is algebra of arrays, compiled once for all models of as many states.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from estimators.prediction_error.ekf import Filtered, Linearised

Matrix = Float[Array, "_ _ experiment"]
Vector = Float[Array, "_ experiment"]


def noise_slope(filtered: Filtered, linear: Linearised, length: Int[Array, ""]) -> Float[Array, "noise experiment"]:
    """Return the derivatives of the negative log-likelihood by the logarithm of each noise: force, torque, then each sensor.

    One pass backwards serves all noises: the derivatives by the predicted state and its covariance are carried from each sample
    to the one before.

    Args:
        filtered: the pass of the filter.
        linear: the linear model along it.
        length: samples of the pass.

    Source: reverse differentiation of the filter's recursion, in which the gain's own change has no effect on the covariance,
    as it is the best; where all samples count it is the score of Koopman and Shephard, Biometrika 79 (1992).
    """
    states, experiments = linear.transition.shape[1], linear.transition.shape[3]

    def back(number: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        by_state, by_spread, slope = carry
        at, row = _row(filtered, linear, length - 1 - number)
        kept, carried = _moved(row, at.gain)
        later = _product(row.pushes, _turned(row.transition))
        # What a change of the covariance of this sample's error does to its likelihood.
        counted = _applied(_turned(at.whitener), at.innovations)
        by_doubt = 0.5 * (_product(_turned(at.whitener), at.whitener) - counted[:, None] * counted[None])
        of_process = _forms(row.pushes, by_spread) + _forms(later, by_spread)
        of_sensor = _forms(_turned(carried), by_spread) - _applied(_turned(carried), by_state) * row.weighed
        of_sensor = (of_sensor + _diagonal(by_doubt)) * linear.variance
        slope = slope + jnp.concatenate([of_process, of_sensor]) + _applied(linear.fresh, _diagonal(by_spread))
        shifted = _applied(_turned(kept), by_state)
        turned = 0.5 * shifted[:, None] * _applied(_turned(row.shown), row.weighed)[None]
        spread = _product(_product(_turned(kept), by_spread), kept) + turned + _turned(turned)
        spread = spread + _product(_product(_turned(row.shown), by_doubt), row.shown)
        return shifted - _applied(_turned(row.shown), counted), spread, slope

    start = [jnp.zeros((*shape, experiments)) for shape in ((states,), (states, states), (len(linear.fresh),))]
    _, by_spread, slope = jax.lax.fori_loop(0, length, back, tuple(start))
    return slope + _applied(linear.stationary, _diagonal(by_spread))


def noise_information(
    filtered: Filtered, linear: Linearised, length: Int[Array, ""]
) -> Float[Array, "noise noise experiment"]:
    """Return the expected curvature of the negative log-likelihood by the logarithm of each noise (Fisher).

    Args:
        filtered: the pass of the filter.
        linear: the linear model along it.
        length: samples of the pass that are looked at.

    Source: Gupta and Mehra, IEEE Transactions on Automatic Control 19 (1974), equations of the sensitivities; the
    covariance's are shorter, as the gain is the best and its own change has no effect.
    """
    outputs, states, experiments = linear.shown.shape[1:]
    count, process = len(linear.fresh), linear.pushes.shape[1]
    sensors = jnp.concatenate([jnp.zeros((process, outputs)), jnp.eye(outputs)])[:, :, None] * linear.variance

    def onward(k: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        """Carry the derivatives of the predicted state and its covariance by each noise one sample on."""
        state, spread, information = carry
        at, row = _row(filtered, linear, k)
        kept, carried = _moved(row, at.gain)
        later = _product(row.pushes, _turned(row.transition))
        error = jax.vmap(lambda one: _applied(at.whitener, _applied(row.shown, one)))(state)
        reach = jax.vmap(lambda one: _product(one, _turned(row.shown)))(spread)
        doubt = jax.vmap(lambda one: _product(row.shown, one))(reach)
        doubt = doubt + jnp.eye(outputs)[:, :, None] * sensors[:, :, None]
        doubt = jax.vmap(lambda one: _product(_product(at.whitener, one), _turned(at.whitener)))(doubt)
        information = information + jnp.sum(error[:, None] * error[None], axis=2)
        information = information + 0.5 * jnp.sum(doubt[:, None] * doubt[None], axis=(2, 3))
        # The change of the gain times the error, from the weighed error.
        state = state + jax.vmap(lambda one: _applied(one, row.weighed))(reach)
        state = jax.vmap(lambda one, own: _applied(kept, one) - _applied(carried, own * row.weighed))(state, sensors)
        spread = jax.vmap(lambda one: _product(_product(kept, one), _turned(kept)))(spread)
        pushed = row.pushes[:, :, None] * row.pushes[:, None] + later[:, :, None] * later[:, None]
        struck = _turned(carried)[:, :, None] * _turned(carried)[:, None] * linear.variance[:, None, None]
        own = jnp.eye(states)[:, :, None] * linear.fresh[:, :, None]
        return state, spread + jnp.concatenate([pushed, struck]) + own, information

    start = (
        jnp.zeros((count, states, experiments)), jnp.eye(states)[:, :, None] * linear.stationary[:, :, None],
        jnp.zeros((count, count, experiments)),
    )  # fmt: skip
    return jax.lax.fori_loop(0, length, onward, start)[2]


def _row(filtered: Filtered, linear: Linearised, k: Int[Array, ""]) -> tuple[Filtered, Linearised]:
    """Return a sample of what has samples."""

    def of(rows: Array) -> Array:
        return jax.lax.dynamic_index_in_dim(rows, k, keepdims=False)

    there = {name: of(getattr(filtered, name)) for name in ("gain", "whitener", "innovations")}
    rows = {name: of(getattr(linear, name)) for name in ("shown", "transition", "pushes", "weighed")}
    return filtered._replace(**there), linear._replace(**rows)


def _moved(row: Linearised, gain: Matrix) -> tuple[Matrix, Matrix]:
    """Return what is left of a change of the predicted state one sample later, and what a change of each error does to it."""
    carried = _product(row.transition, gain)
    return row.transition - _product(carried, row.shown), carried


def _turned(matrix: Matrix) -> Matrix:
    return jnp.swapaxes(matrix, 0, 1)


def _product(a: Matrix, b: Matrix) -> Matrix:
    return jnp.sum(a[:, :, None] * b[None, :, :], axis=1)


def _applied(matrix: Matrix, vector: Vector) -> Vector:
    return jnp.sum(matrix * vector[None], axis=1)


def _forms(rows: Matrix, matrix: Matrix) -> Vector:
    """Return the quadratic form of each row."""
    return jnp.sum(_product(rows, matrix) * rows, axis=1)


def _diagonal(matrix: Matrix) -> Vector:
    return jnp.stack([matrix[place, place] for place in range(len(matrix))])
