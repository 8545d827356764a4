"""Fits of many cases side by side: a fixed number of places in one compiled step, filled from a queue as fits end."""

import collections
import dataclasses
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from estimators.core.bound_transform import slopes
from estimators.core.data import Data
from estimators.core.fisher_information import Information, information_of
from estimators.core.results import RESULTS
from estimators.core.threads import at_once, threads
from estimators.output_error.batched_levenberg_marquardt import (
    Batch,
    begun,
    eliminated,
    ended,
    idle,
    left_over,
    one_step,
    weighted,
)  # fmt: skip
from estimators.output_error.fit_case import Case
from estimators.output_error.normal_equations import Columns, physical
from estimators.output_error.side_by_side import places_for, side_by_side
from rtac_jax.programs import program

TOLERANCE = 1e-7
"""Distance to the minimum, in standard deviations, at which repetitions agree with single fits to a millionth."""

# The slope of a bounded parameter, over its scale, below which it is at its bound: the distance is as small a fraction.
_FLAT = 1e-3
_FLATTEST = (
    1e-9  # of the scale: an unknown that ran far towards its bound has no slope, by which nothing can be divided
)
_NEARBY = 1.0  # standard deviations to the minimum, as far as slopes tell, within which a descent has found it


@dataclasses.dataclass(frozen=True, eq=False)
class End:
    """The end of one fit.

    Attributes:
        values: of the shared parameters, SI units; NaN where the model diverged.
        own: parameters of each experiment.
        start: states at the start.
        residual: rms of each measured channel's residual.
        information: on the shared parameters; None where the model diverged, or what is left is not finite.
        result: how it ended.
        steps: that it took.
        at_bound: whether a parameter ended at a bound.
    """

    values: Float[np.ndarray, " parameter"]
    own: Float[np.ndarray, "own experiment"]
    start: Float[np.ndarray, "state experiment"]
    residual: Float[np.ndarray, " output"]
    information: Information | None
    result: RESULTS
    steps: int
    at_bound: bool


def fit_cases(
    cases: Sequence[Case],
    *,
    substeps: int,
    steps: int = 60,
    tolerance: float = TOLERANCE,
    progress: Callable[[int], object] = lambda count: None,
) -> list[End]:
    """Fit cases of one kind.

    A place whose fit has ended takes the next case, so that none waits for the slowest, and a case has the same bits in
    any company.

    Args:
        cases: of one kind.
        substeps: Runge-Kutta steps per sample.
        steps: optimiser steps to try in each.
        tolerance: distance to the minimum to which a fit comes, as far as its steps tell [standard deviations].
        progress: is told how many fits have ended.

    Raises:
        ValueError: the cases are of several kinds.
    """
    if not cases:
        return []
    if any(case.kind != cases[0].kind for case in cases):
        raise ValueError("cases that are fitted side by side must be of one kind.")
    size = places_for(len(cases[0].experiments))
    queue = collections.deque(range(len(cases)))
    found: dict[int, End] = {}

    def work(_: int) -> None:
        places = _Places(cases, size)
        while places.fill(queue):
            places.step(substeps, steps, tolerance)
            done = places.take_ended(steps)
            found.update(done)
            progress(len(done))

    # As many as have all their places filled: half-empty places cost as much as full ones.
    workers = min(threads(), max(1, len(cases) // size))
    at_once(work, range(workers))
    return [found[number] for number in range(len(cases))]


class _Places:
    """Cases side by side; NumPy arrays that change, of which each step gets a copy."""

    def __init__(self, cases: Sequence[Case], size: int) -> None:
        self.cases, self.size, self.first = cases, size, cases[0]
        self.width = len(self.first.experiments)
        self.holds: list[int | None] = [None] * size
        # An empty place computes what the first case does, and nobody looks at it.
        self.data, self.columns = side_by_side([(self.first.data, self.first.columns)] * size)
        self.noise = np.repeat(self.first.noise, size, axis=1)
        self.batch = begun(np.tile(self.first.unknowns, (1, size)), self.noise.copy())
        idle(self.batch, range(size))
        self.given: tuple[Data, Columns, Array] | None = None

    def fill(self, queue: "collections.deque[int]") -> bool:
        """Give free places the next cases; False where none is left to work at."""
        for place, number in enumerate(self.holds):
            if number is not None:
                continue
            try:
                self.holds[place] = taken = queue.popleft()
            except IndexError:
                break
            case = self.cases[taken]
            columns = slice(place * self.width, (place + 1) * self.width)
            for mine, one in zip(
                jax.tree.leaves((self.data, self.columns)), jax.tree.leaves((case.data, case.columns)), strict=True
            ):
                if np.ndim(mine):
                    mine[..., columns] = one
            self.noise[:, place] = case.noise[:, 0]
            for name, one in begun(case.unknowns, case.noise)._asdict().items():
                by_column = name in ("unknowns", "products")
                getattr(self.batch, name)[..., columns if by_column else slice(place, place + 1)] = one
            self.given = None
        return any(number is not None for number in self.holds)

    def step(self, substeps: int, steps: int, tolerance: float) -> None:
        """Take one step of all fits."""
        if self.given is None:
            copied = jax.tree.map(jnp.array, (self.data, self.columns))
            self.given = (*copied, jnp.array(self.noise))
        data, columns, noise = self.given
        first = self.first
        after = one_step(
            first.model, first.names, first.held, len(first.shared), first.outputs, data, columns,
            jax.tree.map(jnp.array, self.batch), noise, jnp.asarray(substeps), jnp.asarray(steps), jnp.asarray(tolerance),
        )  # fmt: skip
        self.after = after
        self.batch = jax.tree.map(np.array, after)

    def take_ended(self, steps: int) -> dict[int, End]:
        """Return the fits that have ended, and free their places."""
        over = [int(p) for p in np.flatnonzero(ended(self.batch, steps)) if self.holds[p] is not None]
        if not over:
            return {}
        assert self.given is not None
        data, columns, noise = self.given
        summary = _Summary(
            *map(np.asarray, _summary(self.after, columns, data, noise, len(self.first.shared), self.first.outputs))
        )
        done: dict[int, End] = {}
        for place in over:
            number = self.holds[place]
            assert number is not None
            done[number] = self._end(place, self.cases[number], summary)
            self.holds[place] = None
        idle(self.batch, over)
        return done

    def _end(self, place: int, case: Case, summary: "_Summary") -> End:
        columns = slice(place * self.width, (place + 1) * self.width)
        count = len(case.shared)
        values, own = summary.values[:count, columns.start], summary.values[count:, columns]
        start, residual = summary.start[:, columns], summary.residual[:, place]
        steps = int(self.batch.steps[place])
        if self.batch.diverged[place]:
            nothing = np.full_like(values, np.nan)
            return End(
                nothing, own, start, np.full_like(residual, np.nan), None, RESULTS.diverged, steps, at_bound=False
            )
        unknowns = self.batch.unknowns[:count, columns.start]
        lower, upper, scale = (x[:count, 0] for x in (case.columns.lower, case.columns.upper, case.columns.scale))
        slope = slopes(unknowns, lower, upper, scale)
        at_bound = bool(np.any(slope < _FLAT * scale))
        slope = np.maximum(slope, _FLATTEST * scale)
        matrix = summary.matrix[:-1, :-1, place] / np.outer(slope, slope)
        if not np.all(np.isfinite(matrix)):
            return End(values, own, start, residual, None, RESULTS.undetermined, steps, at_bound)
        size = np.maximum(np.abs(values), 0.1 * scale)
        value, vector = np.linalg.eigh(matrix * np.outer(size, size))
        root = np.sqrt(np.maximum(value, 0.0))[:, None] * vector.T / size
        information = information_of(root, case.shared, size)
        converged = self.batch.stage[place] >= 3
        result = RESULTS.successful if converged else RESULTS.steps_exhausted
        if converged and not self.batch.distance[place] < _NEARBY:
            result = RESULTS.stuck
        if information.undetermined():
            result = RESULTS.undetermined
        return End(values, own, start, residual, information, result, steps, at_bound)


@dataclasses.dataclass(frozen=True)
class _Summary:
    values: np.ndarray
    start: np.ndarray
    residual: np.ndarray
    matrix: np.ndarray


@program
def _summary(
    batch: Batch, columns: Columns, data: Data, noise: Array, shared: int, outputs: tuple[int, ...]
) -> tuple[Array, Array, Array, Array]:
    """Return physical values and starts, rms errors, and the normal equations of the shared unknowns."""
    values, start = physical(columns, batch.unknowns)
    rms = left_over(batch, data.present[:, jnp.asarray(outputs)], noise)
    reduced, _, _ = eliminated(weighted(batch, columns), shared, jnp.zeros(noise.shape[1]))
    return values, start, rms, reduced
