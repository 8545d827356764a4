"""Output error of many recordings of one shape at once, for Monte Carlo studies."""

import dataclasses
import time
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from estimators.core.data import CHANNELS, Data, moving, pieces
from estimators.core.progress import Progress
from estimators.core.results import RESULTS
from estimators.core.step_size import accurate_substeps
from estimators.output_error.batched_fit import TOLERANCE, fit_cases
from estimators.output_error.fit_case import Case, shape_of
from rtac_jax import RTAC, require_configured
from rtac_jax.arguments import checked_arguments
from rtac_jax.measurement import Recording

_SHOWN = 6  # numbers of recordings in a line


@dataclasses.dataclass(frozen=True, repr=False)
class BatchFit:
    """Result of `output_error_batch`, in the order of the recordings.

    Attributes:
        names: of the free parameters that the experiments of a recording share.
        values: SI units; not a number where the model diverged.
        covariance: of them.
        result: how each fit ended.
        residual_std: rms of each channel's residual.
        left: the largest of these over its sensor's noise; far above one a fit ended at another minimum, or the model lacks
            something.
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
    left: Float[np.ndarray, " recording"]
    own: Mapping[str, Float[np.ndarray, "recording experiment"]]
    start: Float[np.ndarray, "recording state experiment"]
    experiments: tuple[str, ...]
    steps: Int[np.ndarray, " recording"]
    substeps: int
    seconds: float

    @property
    def std(self) -> Float[np.ndarray, "recording parameter"]:
        """Return the standard deviations of the values."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @property
    def successful(self) -> np.ndarray:
        """Return whether each fit converged [recording]."""
        return np.array([result == RESULTS.successful for result in self.result])

    def __str__(self) -> str:
        good = self.successful
        lines = [repr(self)]
        if np.any(good):
            lines.append(f"{'parameter':24s} {'mean':>12s} {'scatter':>9s} {'stated':>9s}")
        for i, name in enumerate(self.names if np.any(good) else ()):
            values, stated = self.values[good, i], np.sqrt(np.mean(self.std[good, i] ** 2))
            scatter = f"{np.std(values, ddof=1):9.2g}" if len(values) > 1 else f"{'':9s}"
            lines.append(f"{name:24s} {np.mean(values):12.6g} {scatter} {stated:9.2g}")
        sentences = [RESULTS[result] for result in self.result]
        for sentence in dict.fromkeys(sentences):
            which = [str(number) for number, one in enumerate(sentences) if one == sentence]
            if sentence != RESULTS[RESULTS.successful]:
                lines.append(f"{len(which)} ({', '.join(which[:_SHOWN])}{', ...' * (len(which) > _SHOWN)}): {sentence}")
        if np.any(good):
            middle, most = np.median(self.left[good]), np.max(self.left[good])
            lines.append(f"What converged is left at {middle:.2f} times its noise in the median, {most:.2f} at most.")
        return "\n".join(lines)

    def __repr__(self) -> str:
        return (
            f"BatchFit({np.sum(self.successful)} of {len(self.values)} converged, parameters {', '.join(self.names)})"
        )


@checked_arguments
def output_error_batch(
    model: RTAC,
    recordings: Sequence[Recording],
    *,
    start: Mapping[str, float | Sequence[float] | np.ndarray] | None = None,
    steps: int = 60,
    tolerance: float = TOLERANCE,
    substeps: int | None = None,
    progress: bool = True,
) -> BatchFit:
    """Fit a model to each of many recordings by its simulation error, all of them in one compiled loop.

    Each result is that of `output_error` from the same start, with `from_model=True`. It is not led there by predictions:
    a study knows the truth, or the fit around which it draws. A result does not depend on what is fitted beside it.

    Args:
        model: whose free parameters are estimated, at the values where fits begin. Constants with a prior are held at theirs,
            and standard deviations do not count it.
        recordings: with experiments of the same names, lengths, inputs and outputs; what was measured, sample times, values of
            inputs, noise and starts may differ.
        start: values to begin at, of some free parameters, one number or one for each recording; elsewhere the model's.
        steps: optimiser steps to try in each recording.
        tolerance: distance to the minimum to which a fit comes, as far as its steps tell [standard deviations].
        substeps: Runge-Kutta steps per sample; by default so many that more change the first recording's outputs by less
            than a fiftieth of the noise.
        progress: show how far it is, as `core.progress.Progress` does.

    Raises:
        ValueError: no recording, nothing moves in one, recordings of several shapes, no free parameter, or a start of one that
            is not free or of the wrong length.
        RuntimeError: JAX was not configured for double precision.
    """
    require_configured()
    began = time.perf_counter()
    if not recordings:
        raise ValueError("there is no recording; give at least one.")
    model = model.fix(*model.uncertain)
    shared = tuple(name for name in model.free if name not in model.per_experiment)
    _require_one_shape(recordings)
    begin = _begin(shared, len(recordings), start)
    cases = [Case.of(model, recording, at) for recording, at in zip(recordings, begin, strict=True)]
    first = cases[0]
    if substeps is None:
        noise = np.ones(len(CHANNELS))
        noise[list(first.outputs)] = first.noise[:, 0]
        data = Data.of(first.experiments)
        substeps = accurate_substeps(model, data, first.space, first.space.unconstrained(), noise)
    with Progress("output error", show=progress, unit="recordings", total=len(cases)) as shown:
        ends = fit_cases(cases, substeps=substeps, steps=steps, tolerance=tolerance, progress=shown.count)
    unknown = np.full((len(shared), len(shared)), np.nan)
    return BatchFit(
        names=first.shared,
        values=np.stack([end.values for end in ends]),
        covariance=np.stack([unknown if e.information is None else e.information.covariance for e in ends]),
        result=tuple(end.result for end in ends),
        left=np.array([np.max(end.residual / case.noise[:, 0]) for end, case in zip(ends, cases, strict=True)]),
        residual_std={CHANNELS[p]: np.array([e.residual[row] for e in ends]) for row, p in enumerate(first.outputs)},
        own={name: np.stack([end.own[row] for end in ends]) for row, name in enumerate(first.space.each)},
        start=np.stack([end.start for end in ends]),
        experiments=tuple(e.name for e in first.experiments),
        steps=np.array([end.steps for end in ends]),
        substeps=substeps,
        seconds=time.perf_counter() - began,
    )


def _require_one_shape(recordings: Sequence[Recording]) -> None:
    first: object = None
    for number, recording in enumerate(recordings):
        shape = shape_of(pieces(moving(recording)))
        if number and shape != first:
            raise ValueError(
                f"recording {number} has another shape than recording 0: {shape} instead of {first}; all need experiments of "
                "the same names, lengths, inputs and outputs."
            )
        first = shape


def _begin(
    shared: Sequence[str], count: int, start: Mapping[str, float | Sequence[float] | np.ndarray] | None
) -> list[dict[str, float]]:
    """Return the given values of the shared parameters that each recording begins at."""
    given = dict(start or {})
    if unknown := sorted(set(given) - set(shared)):
        raise ValueError(f"start names {', '.join(unknown)}; free and shared are {', '.join(shared)}.")
    for name, value in given.items():
        if np.shape(value) not in {(), (count,)}:
            raise ValueError(f"start of {name} has shape {np.shape(value)}; give one number, or {count}.")
    tables = {name: np.broadcast_to(np.asarray(value, dtype=float), (count,)) for name, value in given.items()}
    return [{name: float(values[number]) for name, values in tables.items()} for number in range(count)]
