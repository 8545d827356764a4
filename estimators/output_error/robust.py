"""Robust output error: Student's distribution in place of Gauss's, by least squares that is weighted again and again."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Shaped

from estimators.core.active_bounds import solve_bounded
from estimators.core.data import CHANNELS, Data
from estimators.core.discounted import Discounted
from estimators.core.jacobian_factor import Arguments, factor, plain_residual
from estimators.core.levenberg_marquardt import Solved
from estimators.core.parameter_space import Space, Unknowns
from estimators.core.progress import Tell
from estimators.core.residual import diagonal_whitener, no_gain
from rtac_jax import RTAC
from rtac_jax.measurement import Experiment, spikes

Samples = Float[np.ndarray, "sample output experiment"]

# Degrees of freedom of Student's distribution: Lange, Little and Taylor, J. Am. Stat. Assoc. 84 (1989), recommend four where the
# data are too few to estimate them; of Gaussian data a fit wastes a tenth with it.
DEGREES = 4.0
# Standard deviations from which on a sample is listed as discounted: chance brings one of 1.7 million there.
LISTED = 5.0
# The median of absolute values of Gaussian numbers of unit variance.
_MEDIAN = 0.6745
_TURNS = 30
# The change of every unknown, in its standard deviations, below which the weights are settled.
_SETTLED = 0.01


class Robust(NamedTuple):
    """The result of a robust fit.

    Attributes:
        solved: where it ended; the factor is that of the honest covariance.
        deviation: scale of each channel's residual, SI units, which faults do not blow up.
        weights: of each sample's square; zero where there is none.
        score_ratio: by which scores that are summed with these weights are too small beside the information; see `robust`.
        discounted: samples that hardly count.
        settled: whether the weights stopped changing.
        cost: negative log-likelihood, less a constant.
    """

    solved: Solved
    deviation: Float[np.ndarray, " output"]
    weights: Samples
    score_ratio: float
    discounted: tuple[Discounted, ...]
    settled: bool
    cost: float


def robust(
    model: RTAC,
    data: Data,
    space: Space,
    unknowns: Unknowns,
    experiments: Sequence[Experiment],
    *,
    substeps: int,
    noise: Float[np.ndarray, " output"],
    tolerance: float,
    steps: int,
    progress: Tell | None = None,
) -> Robust:
    """Fit by the likelihood of Student's distribution, beginning near the optimum of least squares.

    The weights enter as data, so nothing is compiled that a plain fit has not. The covariance is that of an M-estimator: with
    psi the derivative of the negative log-density, E[psi^2] / E[psi']^2 times that of least squares with unit variance, channel
    by channel.

    Args:
        model: that is fitted.
        data: the measurements.
        space: of the unknowns.
        unknowns: to begin at.
        experiments: of the data, in its order.
        substeps: Runge-Kutta steps per sample.
        noise: of the sensors, SI units.
        tolerance: of the last solution.
        steps: most optimiser steps of each solution.
        progress: called after every step.

    Source: Lange, Little and Taylor, J. Am. Stat. Assoc. 84 (1989); Huber, Robust Statistics (1981), section 6.3.
    """
    present = np.asarray(data.present) > 0
    plain = Arguments(
        model, data, space, diagonal_whitener(np.ones(len(CHANNELS)), data), no_gain(model, data), substeps
    )

    def arguments(weights: Samples, deviation: np.ndarray) -> Arguments:
        # The residual is multiplied by what is present, so the root of a weight there weights its square.
        weighted = dataclasses.replace(data, present=jnp.asarray(np.sqrt(weights) * present))
        return dataclasses.replace(plain, data=weighted, whitener=diagonal_whitener(deviation, data))

    def look(at: Unknowns) -> tuple[Samples, np.ndarray, Samples]:
        error = np.asarray(plain_residual(at, plain)[0])
        deviation = _scale(error, present, noise)
        return error, deviation, _weights(error / deviation[None, :, None]) * present

    settled, solved = False, None
    for _ in range(_TURNS):
        _, deviation, weights = look(unknowns)
        solved = solve_bounded(
            unknowns, arguments(weights, deviation), tolerance=tolerance, most=steps, progress=progress
        )
        moved = _moved(unknowns, solved)
        unknowns = solved.unknowns
        if moved < _SETTLED:
            settled = True
            break
    assert solved is not None
    error, deviation, weights = look(unknowns)
    u = error / deviation[None, :, None]
    gain, ratio = _corrections(u, weights, present)
    honest = np.asarray(factor(unknowns, arguments(weights, deviation / gain)))
    counts = present.sum(axis=(0, 2))
    cost = float(np.sum(counts * np.log(deviation)) + 0.5 * (DEGREES + 1) * np.sum(np.log1p(u**2 / DEGREES) * present))
    return Robust(
        solved._replace(factor=honest),
        deviation,
        weights,
        ratio,
        _listed(np.abs(u) * present > LISTED, experiments),
        settled,
        cost,
    )


def without_spikes(experiment: Experiment) -> Experiment:
    """Return an experiment with the spikes of its outputs left out."""
    outputs = {}
    for name, signal in experiment.outputs.items():
        values = signal.values.copy()
        values[spikes(values)] = np.nan
        outputs[name] = dataclasses.replace(signal, values=values)
    return dataclasses.replace(experiment, outputs=outputs)


def _scale(error: Samples, present: Shaped[np.ndarray, "..."], noise: np.ndarray) -> Float[np.ndarray, " output"]:
    """Return the standard deviation of each channel's residual from its median absolute value."""
    found = np.array(noise, dtype=float)
    for row in range(len(CHANNELS)):
        inside = np.abs(error[:, row])[present[:, row]]
        if len(inside):
            found[row] = max(float(np.median(inside)) / _MEDIAN, 1e-12 * noise[row])
    return found


def _weights(u: Samples) -> Samples:
    """Return the weight of the square of each residual in standard deviations."""
    return (DEGREES + 1) / (DEGREES + u**2)


def _corrections(u: Samples, weights: Samples, present: Shaped[np.ndarray, "..."]) -> tuple[np.ndarray, float]:
    """Return by channel the factor that makes the weighted Jacobian that of the honest covariance, and the scores' ratio."""
    slope = (DEGREES + 1) * (DEGREES - u**2) / (DEGREES + u**2) ** 2
    gain, ratios = np.ones(len(CHANNELS)), []
    for row in range(len(CHANNELS)):
        inside = present[:, row]
        if not inside.any():
            continue
        mean = float(np.mean(weights[:, row][inside]))
        curvature = float(np.mean(slope[:, row][inside]))
        power = float(np.mean((weights[:, row] * u[:, row])[inside] ** 2))
        if curvature > 0 and power > 0:
            gain[row] = curvature / np.sqrt(power * mean)
            ratios.append(mean / curvature)
    return gain, float(np.mean(ratios)) if ratios else 1.0


def _moved(before: Unknowns, solved: Solved) -> float:
    """Return the largest step of an unknown in its standard deviations, the others following."""
    shared = len(before.shared)
    step = np.asarray(solved.unknowns.shared) - np.asarray(before.shared)
    own = [np.asarray(after) - np.asarray(then) for after, then in zip(solved.unknowns[1:], before[1:], strict=True)]
    total = 0.0
    for column, block in enumerate(np.asarray(solved.factor)):
        whole = np.concatenate([step[:shared], *(part[:, column] for part in own)])
        # The length of the step in the metric of the Gauss-Newton matrix: no unknown moves by more of its deviations.
        total += float(np.sum((block[:, :-1] @ whole) ** 2))
    return float(np.sqrt(total))


def _listed(
    far: Bool[np.ndarray, "sample output experiment"], experiments: Sequence[Experiment]
) -> tuple[Discounted, ...]:
    found = []
    for column, e in enumerate(experiments):
        for row, channel in enumerate(CHANNELS):
            samples = np.flatnonzero(far[: e.samples, row, column])
            if len(samples):
                found.append(Discounted(e.name, channel, tuple(int(k) for k in samples), e.sample_time))
    return tuple(found)
