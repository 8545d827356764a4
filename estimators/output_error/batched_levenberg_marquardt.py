"""Levenberg-Marquardt on many data sets of one shape in one compiled loop, each with damping and an end of its own."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from estimators.core.data import Data
from estimators.output_error.normal_equations import Columns, normal_equations
from rtac_jax import RTAC
from rtac_jax.excitation import Real
from rtac_jax.programs import program
from rtac_jax.simulation import Steps

# A descent has three stages. The first two give the weights of the channels, which err by the square of the distance to the
# minimum, in standard deviations, over the number of samples: the first ends anywhere near, the second where that square is ten
# times the distance that is asked for in the end.
_STAGES = 3
_NEAR, _OVER_TOLERANCE = 3.0, 10.0
# A gain in log-likelihood that moves no parameter by a fiftieth of its standard deviation, as for a single fit.
_NOTHING = 2e-4
# Dry friction makes kinks, at which no step gains what the linearised problem promises: so many steps in a row that gain
# nothing end a stage. A single fit ends after two.
_TRIES = (2, 2, 6)
_DAMPING, _LEAST_DAMPING = 1e-4, 1e-12  # relative to the diagonal, as Marquardt (1963) takes it
_EASE, _TIGHTEN = 0.01, 10.0
# After a step that failed the damping that served is near what is needed: at a kink, where every other one would fail again.
_EASE_AFTER_FAILURE = 0.3
# Logarithm of what is left over its weight: as the second stage ends it is the square of the distance over the samples.
_STALE = 0.01
_ROUNDING = 1e-12  # of a sum of squares


class Batch(NamedTuple):
    """The state of the descents; R data sets of E experiments, in columns one data set after the other.

    Attributes:
        unknowns: scaled to order one.
        products: of Jacobian and error, at the unknowns.
        deviation: standard deviation by which each output is divided, SI units.
        damping: of Marquardt.
        stage: how many have ended, with which the deviations are set to what is left; 3 where the descent has.
        failed: steps in a row that gained nothing.
        steps: how many were tried; -1 where the unknowns themselves have not been tried yet.
        distance: to the minimum of the linearised problem [standard deviations]; infinite before the first simulation.
        diverged: whether the simulation at the beginning is not finite.
    """

    unknowns: Float[Real, "unknown column"]
    products: Float[Real, "output row row column"]
    deviation: Float[Real, "output set"]
    damping: Float[Real, " set"]
    stage: Int[Real, " set"]
    failed: Int[Real, " set"]
    steps: Int[Real, " set"]
    distance: Float[Real, " set"]
    diverged: Bool[Real, " set"]


def begun(unknowns: Float[np.ndarray, "unknown column"], noise: Float[np.ndarray, "output set"]) -> Batch:
    """Return descents that begin at these unknowns, weighted by the noise of the sensors."""
    outputs, sets = noise.shape
    width = len(unknowns) + 1
    none = np.zeros(sets, dtype=int)
    products = np.zeros((outputs, width, width, unknowns.shape[1]))
    return Batch(
        unknowns, products, noise, np.full(sets, _DAMPING), none, none.copy(), none - 1, np.full(sets, np.inf),
        np.zeros(sets, dtype=bool),
    )  # fmt: skip


def ended(batch: Batch, most: int) -> Bool[np.ndarray, " set"]:
    """Return which descents have ended, or have tried as many steps as they may."""
    return (np.asarray(batch.stage) >= _STAGES) | (np.asarray(batch.steps) >= most)


def idle(batch: Batch, which: Sequence[int]) -> None:
    """Mark places of a batch, whose arrays are NumPy's, as ended."""
    batch.stage[list(which)] = _STAGES


@program
def one_step(
    model: RTAC,
    names: tuple[str, ...],
    held: tuple[str, ...],
    shared: int,
    outputs: tuple[int, ...],
    data: Data,
    columns: Columns,
    batch: Batch,
    noise: Float[Array, "output set"],
    substeps: Steps,
    most: Int[Array, ""],
    tolerance: Float[Array, ""],
) -> Batch:
    """Take one step of every descent that has not ended.

    Each has damping and an end of its own. The starts are minimised out for every experiment apart. After the first and the
    second stage the channels are weighted by what is left of each, so that the third minimises the likelihood with the noise
    levels at their best values. Its last step is not simulated again, where by the steps before it leads to within the
    tolerance. A descent that begins only evaluates its beginning; one whose simulation is not finite there has diverged.

    Args:
        model: that is fitted.
        names: of the parameters.
        held: names of the parameters that are not estimated.
        shared: how many of `names`, the first, all experiments of a data set have in common.
        outputs: places of those that were measured, which `noise` has too.
        data: of all data sets, whose experiments stand side by side as columns.
        columns: how the unknowns of each experiment are placed and scaled.
        batch: where the descents stand.
        noise: of the sensors.
        substeps: Runge-Kutta steps per sample.
        most: steps to try.
        tolerance: distance to the minimum to which a descent comes, as far as its steps tell [standard deviations].

    Source: Marquardt (1963); the starts are eliminated as in the variable projection of Golub and Pereyra (1973).
    """
    sets = noise.shape[1]
    last = _STAGES
    nearness = jnp.stack([jnp.asarray(_NEAR), jnp.sqrt(_OVER_TOLERANCE * tolerance), tolerance])
    active = (batch.stage < last) & (batch.steps < most)
    fresh = active & (batch.steps < 0)

    matrix = weighted(batch, columns)
    step, _ = _newton(matrix, shared, batch.damping)
    trial = batch.unknowns + jnp.where(_per_column(active & ~fresh, batch), step, 0.0)
    there_model = model.with_values(dict(zip(held, columns.known, strict=True)))
    products = normal_equations(there_model, names, outputs, data, columns, trial, substeps=substeps)
    finite = jnp.all(jnp.isfinite(products).reshape(-1, sets, products.shape[-1] // sets), axis=(0, 2))
    there = weighted(batch._replace(unknowns=trial, products=products), columns)
    now, then = (0.5 * jnp.sum(x[-1, -1], axis=-1) for x in (matrix, there))
    better = active & finite & (fresh | (then <= now * (1.0 + _ROUNDING)))
    take = _per_column(better, batch)
    gained = better & (fresh | (now - then > _NOTHING))
    tried = active & ~fresh
    eased = jnp.where(batch.failed > 0, _EASE_AFTER_FAILURE, _EASE) * batch.damping
    eased = jnp.maximum(eased, _LEAST_DAMPING)
    after = batch._replace(
        unknowns=jnp.where(take, trial, batch.unknowns),
        products=jnp.where(take, products, batch.products),
        damping=jnp.where(tried, jnp.where(better, eased, _TIGHTEN * batch.damping), batch.damping),
        failed=jnp.where(gained, 0, batch.failed + tried),
        steps=batch.steps + active,
        diverged=batch.diverged | (fresh & ~finite),
        stage=jnp.where(fresh & ~finite, last, batch.stage),
    )

    def next_stage(at: Batch, done: Array) -> Batch:
        done = done & (at.stage < last)
        rms = left_over(at, data.present[:, jnp.asarray(outputs)], noise)
        # Where the last stage leaves less than it was weighted by, it goes on with what it leaves: its weights came from a descent
        # that was stuck, and its deviations with them.
        stale = jnp.any(jnp.abs(jnp.log(rms / at.deviation)) > _STALE, axis=0)
        again = done & (at.stage == last - 1) & stale
        return at._replace(
            stage=at.stage + (done & ~again),
            failed=jnp.where(done, 0, at.failed),
            deviation=jnp.where((done & (at.stage < last - 1)) | again, rms, at.deviation),
            damping=jnp.where(again, _DAMPING, at.damping),
        )

    stuck = tried & (after.failed >= jnp.asarray(_TRIES)[jnp.minimum(batch.stage, last - 1)])
    after = next_stage(after, stuck)
    descending = after.stage < last

    def look(_: Array, state: tuple[Batch, Array]) -> tuple[Batch, Array]:
        at, _ = state
        step, left = _newton(weighted(at, columns), shared, jnp.zeros_like(at.damping))
        distance = jnp.sqrt(2.0 * jnp.maximum(left, 0.0))
        # Steps before came so many times nearer, and the next one does.
        ahead = distance**2 / jnp.maximum(jnp.maximum(batch.distance, distance), _ROUNDING)
        asked = nearness[jnp.minimum(at.stage, last - 1)]
        done = tried & (jnp.where(at.stage == last - 1, ahead, distance) < asked)
        return next_stage(at._replace(distance=distance), done), step

    # New weights may leave it as close, which costs no simulation to see.
    after, step = jax.lax.fori_loop(0, _STAGES, look, (after, jnp.zeros_like(step)))
    step = jnp.where(_per_column(descending & (after.stage == last), batch), step, 0.0)
    # What it leaves is known as far as the problem is linear: the error there is the error here and Jacobian times step.
    along = jnp.concatenate([step, jnp.ones((1, step.shape[1]))])
    squares = jnp.einsum("ic,oijc,jc->oc", along, after.products, along)
    return after._replace(unknowns=after.unknowns + step, products=after.products.at[:, -1, -1].set(squares))


def left_over(batch: Batch, present: Array, noise: Array) -> Float[Array, "output set"]:
    """Return the rms error of each output of each data set; where nothing is left, the sensor's noise."""
    outputs, sets = noise.shape
    squares = batch.products[:, -1, -1].reshape(outputs, sets, -1).sum(axis=2)
    count = present.sum(axis=0).reshape(outputs, sets, -1).sum(axis=2)
    rms = jnp.sqrt(squares / jnp.maximum(count, 1.0))
    # A channel cannot be trusted beyond its sensor, or one that happens to fit would drown the others.
    return jnp.where(rms > 0, jnp.maximum(rms, 1e-12 * noise), noise)


def weighted(batch: Batch, columns: Columns) -> Float[Array, "row row set experiment"]:
    """Return the products in units of the deviations, with what is known of the starts."""
    outputs, sets = batch.deviation.shape
    width = batch.products.shape[1]
    products = batch.products.reshape(outputs, width, width, sets, -1)
    matrix = jnp.sum(products / (batch.deviation**2)[:, None, None, :, None], axis=0)
    count = len(columns.lower)
    start = batch.unknowns[count:]
    slope = jnp.where(columns.start_held > 0, 1.0, columns.start_scale / columns.start_spread)
    known = jnp.concatenate([jnp.zeros_like(batch.unknowns[:count]), slope]).reshape(width - 1, sets, -1)
    error = jnp.concatenate([jnp.zeros_like(batch.unknowns[:count]), slope * start]).reshape(width - 1, sets, -1)
    place = jnp.arange(width - 1)
    matrix = matrix.at[place, place].add(known**2)
    matrix = matrix.at[place, -1].add(known * error).at[-1, place].add(known * error)
    return matrix.at[-1, -1].add(jnp.sum(error**2, axis=0))


def eliminated(
    matrix: Float[Array, "row row set experiment"], shared: int, damping: Float[Array, " set"]
) -> tuple[Float[Array, "kept kept set"], Array, Array]:
    """Return the normal equations of the shared unknowns and the error, and of the others coupling and solution."""
    own = matrix[shared:-1, shared:-1]
    kept = [*range(shared), matrix.shape[0] - 1]
    coupling = matrix[shared:-1][:, jnp.asarray(kept)]
    lower = _cholesky(_damped(own, damping[:, None]))
    solved = _solve(lower, coupling)
    index = jnp.asarray(kept)
    rest = matrix[index][:, index] - jnp.einsum("oi...,oj...->ij...", coupling, solved)
    return jnp.sum(rest, axis=-1), coupling, solved


def _newton(matrix: Array, shared: int, damping: Array) -> tuple[Array, Array]:
    """Return the damped step [unknown column], and by how much the undamped one lowers the linearised cost."""
    whole, coupling, solved = eliminated(matrix, shared, jnp.zeros_like(damping))
    lower = _cholesky(_damped(whole[:-1, :-1], jnp.zeros_like(damping)))
    by_shared = jnp.sum(whole[:-1, -1] * _solve(lower, whole[:-1, -1:])[:, 0], axis=0) if shared else 0.0
    own = jnp.sum(coupling[:, -1] * solved[:, -1], axis=(0, -1))
    left = 0.5 * (by_shared + own)

    reduced, _, solved = eliminated(matrix, shared, damping)
    diagonal = jnp.sum(jnp.stack([matrix[i, i] for i in range(shared)]), axis=-1) if shared else None
    lower = _cholesky(_damped(reduced[:-1, :-1], damping, diagonal))
    common = -_solve(lower, reduced[:-1, -1:])[:, 0]
    others = -solved[:, -1] - jnp.einsum("oi...,i...->o...", solved[:, :-1], common[..., None])
    step = jnp.concatenate([jnp.broadcast_to(common[..., None], (shared, *others.shape[1:])), others])
    return step.reshape(len(step), -1), left


def _damped(matrix: Array, damping: Array, diagonal: Array | None = None) -> Array:
    """Return the matrix with its diagonal raised; what has no influence at all is held."""
    place = jnp.arange(len(matrix))
    own = matrix[place, place]
    extra = damping * (own if diagonal is None else diagonal)
    return matrix.at[place, place].set(jnp.where(own > 0, own + extra, 1.0))


class _Lower(NamedTuple):
    """The lower triangular factor of many small matrices: what stands on the diagonal, and what below it."""

    diagonal: Float[Array, "row *batch"]
    below: Float[Array, "row row *batch"]


def _cholesky(matrix: Float[Array, "row row *batch"]) -> _Lower:
    """Return the lower factor.

    The matrices are small and many: the batch is what is vectorised, and LAPACK's threads are left alone. Of a loop over columns
    the compiler sees one; written out, numbers of the matrices were half of what a step took to compile.
    """
    row = jnp.arange(len(matrix)).reshape(-1, *[1] * (matrix.ndim - 2))

    def column(k: Array, state: tuple[Array, _Lower]) -> tuple[Array, _Lower]:
        rest, factor = state
        # A pivot lost to rounding belongs to a direction that the data leave free: it is not moved along.
        pivot = jnp.sqrt(jnp.where(rest[k, k] > 1e-14 * matrix[k, k], rest[k, k], jnp.inf))
        below = jnp.where(row > k, rest[:, k] / pivot, 0.0)
        after = _Lower(factor.diagonal.at[k].set(pivot), factor.below.at[:, k].set(below))
        return rest - below[:, None] * below[None], after

    begin = _Lower(jnp.zeros_like(matrix[:, 0]), jnp.zeros_like(matrix))
    return jax.lax.fori_loop(0, len(matrix), column, (matrix, begin))[1]


def _solve(lower: _Lower, right: Float[Array, "row side *batch"]) -> Array:
    last = len(right) - 1

    def forwards(k: Array, rest: Array) -> Array:
        value = rest[k] / lower.diagonal[k]
        return rest.at[k].set(value) - lower.below[:, k, None] * value

    def backwards(n: Array, rest: Array) -> Array:
        k = last - n
        value = rest[k] / lower.diagonal[k]
        return rest.at[k].set(value) - lower.below[k, :, None] * value

    for substitute in (forwards, backwards):
        right = jax.lax.fori_loop(0, len(right), substitute, right)
    return right


def _per_column(of_set: Array, batch: Batch) -> Array:
    columns = batch.unknowns.shape[1]
    return jnp.repeat(of_set, columns // len(of_set), total_repeat_length=columns)
