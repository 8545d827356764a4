"""Prediction errors of a linear model along a condition, and the fit of all conditions at once that makes them small."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from estimators.linear.batched_gauss_newton import gauss_newton
from estimators.linear.model_sets import Sampled, Scale, Structure, sampled
from rtac_jax.programs import program
from rtac_jax.time_loop import time_loop

_NOTHING = 1e-13  # of the variance of e, below which states of H are known


class Signals(eqx.Module):
    """Conditions as arrays of one length; the shorter ones end with samples that are not present.

    Attributes:
        input: polynomials over the interval that follows each sample, rising powers.
        output: zero where it was not measured.
        present: 1 where the output was measured, else 0.
        interval: between samples [s].
        scale: of each condition.
        gaps: whether samples are missing among others.
    """

    input: Float[Array, "*condition sample power"]
    output: Float[Array, "*condition sample"]
    present: Float[Array, "*condition sample"]
    interval: Float[Array, "*condition"]
    scale: Scale
    gaps: bool = eqx.field(static=True, default=False)


class Track(NamedTuple):
    """The output of a predictor at each sample.

    Attributes:
        error: output less its prediction from the past; zero where there is no output.
        simulated: G u, with the start.
        noise: states of H after the sample; the first is the prediction of H e one sample ahead.
        spread: by how much errors scatter more than e, geometric mean: those after a gap do.
    """

    error: Float[Array, "*condition sample"]
    simulated: Float[Array, "*condition sample"]
    noise: Float[Array, "*condition sample order"]
    spread: Float[Array, "*condition"]


def track(model: Sampled, one: Signals) -> Track:
    """Run the predictor of section 5.1, L_1 = 1 - 1/H and L_2 = G/H, and keep all that it knows."""
    step, begin = _predictor(model, gaps=one.gaps)
    samples = one.output.shape[-1]
    # A plain scan would copy the arrays that it shows whole in every step.
    signals = (one.input, one.output, one.present)
    _, (error, size, simulated, noise) = time_loop(step, begin, signals, room=samples, samples=samples)
    stacked = jnp.stack(noise, -1) if noise else jnp.zeros((*error.shape, 0))
    return Track(error, simulated, stacked, _spread(size, one.present))


def _spread(size: Float[Array, " sample"], present: Float[Array, " sample"]) -> Float[Array, ""]:
    """Return the geometric mean of the sizes of errors."""
    return jnp.exp(jnp.sum(present * jnp.log(size)) / jnp.sum(present))


def _errors(model: Sampled, one: Signals) -> Float[Array, " sample"]:
    """Run the same predictor, and keep its errors alone, as often weighted as each is known.

    Their sum of squares is that of the likelihood with the variance of e at its best: each error over its size, times the
    geometric mean of the sizes.
    """
    step, begin = _predictor(model, gaps=one.gaps)

    def shown(carry: tuple[Any, Array], row: Any) -> tuple[tuple[Any, Array], Array]:
        at, total = carry
        after, (error, size, _, _) = step(at, row)
        if not one.gaps:
            return (after, total), error
        # Summed here: of two arrays that a loop shows XLA copies one whole in every step.
        return (after, total + row[2] * jnp.log(size)), error / size

    (_, total), error = jax.lax.scan(shown, (begin, jnp.zeros(())), (one.input, one.output, one.present))
    return error * jnp.exp(total / jnp.sum(one.present)) if one.gaps else error


def _predictor(model: Sampled, *, gaps: bool) -> tuple[Callable[[Any, Any], tuple[Any, Any]], Any]:
    """Return the step of a predictor, which shows error, its size over e, G u and the states of H, and what it begins with.

    Where samples are missing it is Kalman's: with all of them the states of H are known, after a gap they are not, so the next
    errors are larger and correct them by more. It carries the covariance of these states over the variance of e.

    Source: Jones, Technometrics 22 (1980).
    """
    modes, order = model.transition.shape[0], len(model.c)
    uncertain = gaps and order > 0
    through = [model.c[i] - model.d[i] for i in range(order)]  # from e to the states

    def step(carry: tuple[Any, ...], row: tuple[Any, Any, Any]) -> tuple[tuple[Any, ...], Any]:
        # Scalars rather than small arrays: over a batch they become loops that vectorise.
        states, noise, *rest = carry
        powers, output, present = row
        simulated = model.feedthrough * powers[0]
        for position, _ in states:
            simulated = simulated + position
        expected = noise[0] if order else 0.0
        error = present * (output - simulated - expected)
        gain, size = through, jnp.ones(())
        if uncertain:
            gain, size, known = _corrected(model, through, rest[0], present)
            rest = [known]
        after = tuple(
            (noise[i + 1] if i + 1 < order else 0.0) - model.d[i] * expected + gain[i] * error for i in range(order)
        )
        moved = []
        for k in range(modes):
            f, g, (x, v) = model.transition[k], model.drive[k], states[k]
            pushed = [sum(g[row, j] * powers[j] for j in range(g.shape[1])) for row in range(2)]
            moved.append(tuple(f[row, 0] * x + f[row, 1] * v + pushed[row] for row in range(2)))
        return (tuple(moved), after, *rest), (error, size, simulated, after)

    begin = (tuple((s[0], s[1]) for s in model.start), tuple(model.noise_start))
    nothing = tuple(tuple(jnp.zeros(()) for _ in range(order)) for _ in range(order))
    return step, (*begin, nothing) if uncertain else begin


_Table = tuple[tuple[Array, ...], ...]


def _corrected(
    model: Sampled, through: Sequence[Array], known: _Table, present: Array
) -> tuple[list[Array], Array, _Table]:
    """Return the gain of a sample's error on the states of H, the size of that error over e, and the covariance after it."""
    order = len(through)
    variance = known[0][0] + 1.0
    # Row i + 1 less d_i times row 0, as the states themselves move; there is no row behind the last.
    carried = [
        [(known[i + 1][j] if i + 1 < order else 0.0) - model.d[i] * known[0][j] for j in range(order)]
        for i in range(order)
    ]
    gain = [(carried[i][0] + through[i]) / variance for i in range(order)]

    def covariance(i: int, j: int) -> Array:
        onward = (carried[i][j + 1] if j + 1 < order else 0.0) - model.d[j] * carried[i][0] + through[i] * through[j]
        return onward - present * variance * gain[i] * gain[j]

    left = [[covariance(i, j) for j in range(order)] for i in range(order)]
    # It dies out, and numbers next to zero take a hundred times as long as others.
    alive = sum(left[i][i] for i in range(order)) > _NOTHING
    return gain, jnp.sqrt(variance), tuple(tuple(jnp.where(alive, x, 0.0) for x in row) for row in left)


def _sampled(structure: Structure, theta: Array, one: Signals) -> Sampled:
    return sampled(structure, theta, one.scale, one.interval, one.input.shape[-1])


def prediction_errors(structure: Structure, theta: Float[Array, " unknown"], one: Signals) -> Float[Array, " sample"]:
    """Return prediction errors over their size."""
    return _errors(_sampled(structure, theta, one), one) / one.scale.error


class Rows(NamedTuple):
    """Prediction errors of all conditions, in units of their scale, and their derivatives by the unknowns."""

    error: Float[Array, "condition sample"]
    jacobian: Float[Array, "condition sample unknown"]


@program
def rows(structure: Structure, theta: Float[Array | np.ndarray, "condition unknown"], data: Signals) -> Rows:
    """Return prediction errors and Jacobian at these unknowns."""

    def of_one(at: Array, one: Signals) -> Rows:
        return Rows(
            prediction_errors(structure, at, one), jax.jacfwd(lambda t: prediction_errors(structure, t, one))(at)
        )

    return jax.vmap(of_one)(jnp.asarray(theta), data)


@program
def tracks(
    structure: Structure, theta: Float[Array | np.ndarray, "condition unknown"], data: Signals
) -> tuple[Track, Sampled]:
    """Return the predictors and their outputs, in the output's unit."""

    def of_one(at: Array, one: Signals) -> tuple[Track, Sampled]:
        model = _sampled(structure, at, one)
        return track(model, one), model

    return jax.vmap(of_one)(jnp.asarray(theta), data)


class Solved(NamedTuple):
    """The solution of each condition: unknowns, half the sum of squares, whether it converged."""

    theta: Float[np.ndarray, "condition unknown"]
    cost: Float[np.ndarray, " condition"]
    converged: Bool[np.ndarray, " condition"]


@program
def _solve(
    structure: Structure, theta: Float[Array, "condition unknown"], data: Signals, most: Int[Array, ""]
) -> tuple[Array, Array, Array]:
    def of_one(at: Array, one: Signals) -> tuple[Array, Array, Array]:
        found, converged = gauss_newton(lambda t: prediction_errors(structure, t, one), at, most=most)
        return found.theta, found.cost, converged

    return jax.vmap(of_one)(theta, data)


def solve(
    structure: Structure, theta: Float[np.ndarray, "condition unknown"], data: Signals, *, most: int = 60
) -> Solved:
    """Minimise the sum of squares of each condition's prediction errors; all conditions in one compiled call."""
    return Solved(*(np.asarray(x) for x in _solve(structure, jnp.asarray(theta), data, jnp.asarray(most))))
