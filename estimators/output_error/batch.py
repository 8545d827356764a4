"""Output error of many recordings of one shape at once, for Monte Carlo studies."""

import dataclasses
import time
from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from tqdm import tqdm

from estimators.core.bound_transform import slopes, to_unconstrained
from estimators.core.data import CHANNELS, Data, moving, pieces
from estimators.core.fisher_information import Information, information_of
from estimators.core.initial_state import initial_states, space_of
from estimators.core.parameter_space import Space
from estimators.core.results import RESULTS
from estimators.core.sensor_noise import noise_levels
from estimators.core.step_size import accurate_substeps
from estimators.core.threads import at_once
from estimators.output_error.batched_levenberg_marquardt import Batch, descend, eliminated, left_over, weighted
from estimators.output_error.normal_equations import Columns, physical
from rtac_jax import RTAC, require_configured
from rtac_jax.measurement import Experiment, Recording

# Experiments side by side in one compiled loop: their states and sensitivities stay in a core's cache.
_COLUMNS = 256


@dataclasses.dataclass(frozen=True)
class BatchFit:
    """Result of `output_error_batch`, in the order of the recordings.

    Attributes:
        names: of the free parameters that all experiments of a recording share.
        values: SI units; not a number where the model diverged.
        covariance: of them.
        result: how each fit ended.
        residual_std: rms of each channel's residual.
        own: parameters of each experiment, by name.
        start: states at the start of each experiment, SI units.
        experiments: names of the experiments.
        steps: that each fit took.
        substeps: Runge-Kutta steps per sample.
        seconds: that all took.
    """

    names: tuple[str, ...]
    values: Float[np.ndarray, "recording parameter"]
    covariance: Float[np.ndarray, "recording parameter parameter"]
    result: tuple[RESULTS, ...]
    residual_std: Mapping[str, Float[np.ndarray, " recording"]]
    own: Mapping[str, Float[np.ndarray, "recording experiment"]]
    start: Float[np.ndarray, "recording state experiment"]
    experiments: tuple[str, ...]
    steps: Int[np.ndarray, " recording"]
    substeps: int
    seconds: float

    @property
    def std(self) -> Float[np.ndarray, "recording parameter"]:
        """Standard deviations of the values."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @property
    def successful(self) -> np.ndarray:
        """Whether each fit converged [recording]."""
        return np.array([result == RESULTS.successful for result in self.result])

    def __repr__(self) -> str:
        return (
            f"BatchFit({np.sum(self.successful)} of {len(self.values)} converged, parameters {', '.join(self.names)})"
        )


def output_error_batch(
    model: RTAC,
    recordings: Sequence[Recording],
    *,
    start: Mapping[str, float | Sequence[float] | np.ndarray] | None = None,
    steps: int = 60,
    substeps: int | None = None,
    progress: bool = True,
) -> BatchFit:
    """Fit a model to each of many recordings by its simulation error, all of them in one compiled loop.

    Each result is that of `output_error` from the same start, with `from_model=True`. It is not led there by predictions:
    a study knows the truth, or the fit around which it draws.

    Args:
        model: whose free parameters are estimated, at the values where fits begin. Constants with a prior are held at theirs,
            and standard deviations do not count it.
        recordings: with experiments of the same names, lengths, inputs and outputs; what was measured, sample times, values of
            inputs, noise and starts may differ.
        start: values to begin at, of some free parameters, one number or one for each recording; elsewhere the model's.
        steps: optimiser steps to try in each recording.
        substeps: Runge-Kutta steps per sample; by default so many that more change the first recording's outputs by less
            than a fiftieth of the noise.
        progress: show a bar.

    Raises:
        ValueError: no recording, nothing moves in one, recordings of several shapes, no free parameter, or a start of one that
            is not free or of the wrong length.
        RuntimeError: JAX was not configured for double precision.
    """
    require_configured()
    began = time.perf_counter()
    if not recordings:
        raise ValueError("there is no recording; give at least one.")
    several = [pieces(moving(recording)) for recording in recordings]
    _require_one_shape(several)
    model = model.fix(*model.uncertain)
    shared = tuple(name for name in model.free if name not in model.per_experiment)
    if not shared:
        raise ValueError(
            "The model has no free parameter that experiments share; release one with model.release(name)."
        )
    space = space_of(model, several[0], free=list(shared))
    outputs = tuple(place for place, c in enumerate(CHANNELS) if any(c in e.outputs for e in several[0]))
    levels = [noise_levels(recording.experiments) for recording in recordings]
    noise = np.array([[one.get(CHANNELS[place], 1.0) for place in outputs] for one in levels])
    if substeps is None:
        first = np.array([levels[0].get(channel, 1.0) for channel in CHANNELS])
        substeps = accurate_substeps(model, Data.of(several[0]), space, space.unconstrained(), first)
    begin = _begin(space, shared, len(several), start)
    job = _Job(model, space, shared, outputs, substeps, steps)

    count = len(several)
    size = min(max(1, _COLUMNS // len(several[0])), 2 ** int(np.ceil(np.log2(count))))
    chunks = [range(at, min(at + size, count)) for at in range(0, count, size)]
    bar = tqdm(total=count, disable=not progress, desc="output error", unit=" recordings", leave=False)

    def work(chunk: range) -> _Ends:
        # The last chunk is filled up, so that it needs no code of its own.
        padded = [*chunk, *[chunk[-1]] * (size - len(chunk))]
        ends = job.fit([several[i] for i in padded], begin[padded], noise[padded])
        bar.update(len(chunk))
        return _Ends(*(part[: len(chunk)] for part in ends_of(ends)))

    found = [np.concatenate(parts) for parts in zip(*(ends_of(e) for e in at_once(work, chunks)), strict=True)]
    bar.close()
    ends = _Ends(*found)
    judged = [_judged(job, ends, i) for i in range(count)]
    return BatchFit(
        names=shared,
        values=ends.values,
        covariance=np.stack([covariance for _, covariance in judged]),
        result=tuple(result for result, _ in judged),
        residual_std={CHANNELS[place]: ends.residual[:, row] for row, place in enumerate(outputs)},
        own={name: ends.own[:, row] for row, name in enumerate(space.each)},
        start=ends.start,
        experiments=tuple(e.name for e in several[0]),
        steps=ends.steps,
        substeps=substeps,
        seconds=time.perf_counter() - began,
    )


def _require_one_shape(several: Sequence[Sequence[Experiment]]) -> None:
    def shape(experiments: Sequence[Experiment]) -> list[tuple[object, ...]]:
        return [(e.name, e.samples, e.arm, e.cart, tuple(e.inputs), tuple(e.outputs)) for e in experiments]

    first = shape(several[0])
    for number, experiments in enumerate(several):
        if (other := shape(experiments)) != first:
            raise ValueError(
                f"recording {number} has another shape than recording 0: {other} instead of {first}; all need experiments of "
                "the same names, lengths, inputs and outputs."
            )


def _begin(
    space: Space, shared: Sequence[str], count: int, start: Mapping[str, float | Sequence[float] | np.ndarray] | None
) -> Float[np.ndarray, "recording parameter"]:
    """Return unconstrained values of the shared parameters to begin at."""
    given = dict(start or {})
    if unknown := sorted(set(given) - set(shared)):
        raise ValueError(f"start names {', '.join(unknown)}; free and shared are {', '.join(shared)}.")
    active = np.asarray(space.active)
    values = np.tile(np.asarray(space.values)[active], (count, 1))
    for name, value in given.items():
        if np.shape(value) not in {(), (count,)}:
            raise ValueError(f"start of {name} has shape {np.shape(value)}; give one number, or {count}.")
        values[:, shared.index(name)] = value
    return to_unconstrained(values, *(np.asarray(x)[active] for x in (space.lower, space.upper, space.scale)))


@dataclasses.dataclass(frozen=True)
class _Ends:
    """Ends of some fits, first axis the recordings."""

    values: np.ndarray
    own: np.ndarray
    start: np.ndarray
    residual: np.ndarray
    matrix: np.ndarray
    steps: np.ndarray
    converged: np.ndarray
    diverged: np.ndarray


def ends_of(ends: _Ends) -> list[np.ndarray]:
    """Return the arrays."""
    return [getattr(ends, field.name) for field in dataclasses.fields(ends)]


@dataclasses.dataclass(frozen=True)
class _Job:
    """What all chunks have in common."""

    model: RTAC
    space: Space
    shared: tuple[str, ...]
    outputs: tuple[int, ...]
    substeps: int
    steps: int

    @property
    def bounds(self) -> tuple[Array, Array, Array]:
        """Lower and upper bounds and scales of the free parameters, the shared ones first."""
        space = self.space
        return (
            jnp.concatenate([space.lower[space.active], space.each_lower]),
            jnp.concatenate([space.upper[space.active], space.each_upper]),
            jnp.concatenate([space.scale[space.active], space.each_scale]),
        )

    def fit(self, several: Sequence[Sequence[Experiment]], begin: np.ndarray, noise: np.ndarray) -> _Ends:
        """Fit some recordings, side by side."""
        space, sets, count = self.space, len(several), len(several[0])
        starts = [initial_states(experiments) for experiments in several]

        def tiled(x: Array, row: int | None = None) -> np.ndarray:
            table = np.tile(np.asarray(x), (1, sets))
            if row is not None:
                table[:4] = np.concatenate([one[row] for one in starts], axis=1)
            return table

        columns = Columns(
            *self.bounds,
            start=jnp.asarray(tiled(space.start, 0)),
            start_scale=jnp.asarray(tiled(space.start_scale)),
            start_spread=jnp.asarray(tiled(space.start_spread, 1)),
            start_held=jnp.asarray(tiled(space.start_held, 2)),
        )
        own = np.asarray(space.unconstrained().each)
        unknowns = np.concatenate(
            [np.repeat(begin.T, count, axis=1), np.tile(own, (1, sets)), np.zeros_like(columns.start)]
        )
        data = Data.of([e for experiments in several for e in experiments])
        names = (*self.shared, *space.each)
        batch, diverged = descend(
            self.model, names, len(self.shared), self.outputs, data, columns, jnp.asarray(unknowns), jnp.asarray(noise.T),
            jnp.asarray(self.substeps), jnp.asarray(self.steps),
        )  # fmt: skip
        return self._ends(batch, columns, data, noise, np.asarray(diverged))

    def _ends(self, batch: Batch, columns: Columns, data: Data, noise: np.ndarray, diverged: np.ndarray) -> _Ends:
        sets, shared = len(noise), len(self.shared)

        def by_set(x: Array) -> np.ndarray:
            return np.moveaxis(np.asarray(x).reshape(x.shape[0], sets, -1), 1, 0)

        values, start = physical(columns, batch.unknowns)
        rms = left_over(batch, data.present[:, jnp.asarray(self.outputs)], jnp.asarray(noise.T))
        reduced, _, _ = eliminated(weighted(batch, columns), shared, jnp.zeros(sets))
        slope = np.asarray(
            slopes(*(np.ravel(np.broadcast_to(np.asarray(x), (sets, shared))) for x in (
                by_set(batch.unknowns)[:, :shared, 0], *(bound[:shared] for bound in self.bounds)
            )))
        ).reshape(sets, shared)  # fmt: skip
        matrix = np.moveaxis(np.asarray(reduced)[:-1, :-1], -1, 0) / (slope[:, :, None] * slope[:, None, :])
        of_shared = by_set(values)[:, :shared, 0]
        return _Ends(
            values=np.where(diverged[:, None], np.nan, of_shared),
            own=by_set(values)[:, shared:],
            start=by_set(start),
            residual=np.where(diverged[:, None], np.nan, np.asarray(rms).T),
            matrix=matrix,
            steps=np.asarray(batch.steps),
            converged=np.asarray(batch.stage) == 3,
            diverged=diverged,
        )


def _judged(job: _Job, ends: _Ends, place: int) -> tuple[RESULTS, np.ndarray]:
    """How a fit ended, and the covariance of its parameters."""
    count = len(job.shared)
    if ends.diverged[place]:
        return RESULTS.diverged, np.full((count, count), np.nan)
    scale = np.asarray(job.bounds[2])[:count]
    size = np.maximum(np.abs(ends.values[place]), 0.1 * scale)
    value, vector = np.linalg.eigh(ends.matrix[place] * np.outer(size, size))
    root = np.sqrt(np.maximum(value, 0.0))[:, None] * vector.T / size
    found: Information = information_of(root, job.shared, size)
    if found.undetermined():
        return RESULTS.undetermined, found.covariance
    return (RESULTS.successful if ends.converged[place] else RESULTS.steps_exhausted), found.covariance
