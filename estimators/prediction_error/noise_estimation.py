"""Prediction one sample ahead: sensor and process noise by maximum likelihood, physics by least squares on innovations."""

import dataclasses
from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from estimators.core.active_bounds import solve_bounded
from estimators.core.data import CHANNELS, Data
from estimators.core.deadline import require_time
from estimators.core.jacobian_factor import Arguments, Passes
from estimators.core.parameter_space import Physical, Space, Unknowns
from estimators.core.progress import Tell
from estimators.prediction_error.ekf import Filtered
from estimators.prediction_error.filter_pass import (
    Curvature,
    Passed,
    prepare_filter,
    run_filter,
    score_noise,
    without_shaken,
)
from estimators.prediction_error.noise_model import NoiseModel
from rtac_jax import RTAC
from rtac_jax.programs.arrays import to_jax
from rtac_jax.simulation import Steps

# Random force and torque between these fractions of the rms forces, as powers of e of their variance.
# A force beyond the rms force comes from wrong physics and would keep it wrong; a motor's torque is small beside what can
# shake it.
_LEAST, _FIRST = np.log(1e-5**2), np.log(3e-3**2)
_MOST = (np.log(1.0**2), np.log(10.0**2))
_LOW = np.log(1e-3**2)  # where they should not hide an effect
_FAR = 3.0  # the longest step in the logarithm of a variance
_LITTLE = 0.1  # gain in log-likelihood that is not worth another pass of the filter
_PASSES = 25
_PART = 8  # the first of so many parts of all experiments tell the noise where it is far off
_FEWEST = 200  # samples of that part
_MUCH = 100.0  # gain in log-likelihood that a step must promise to be called far off
_LESS = (0.0, 4.0)  # by how much in the logarithm of the variance
_ENOUGH = 1.0  # gain in log-likelihood that is worth another round
# Gain in log-likelihood for which physics at frozen gains takes no further step: none moves a parameter by 0.05 deviations.
_PHYSICS = 1e-3


@dataclasses.dataclass(frozen=True)
class Predictor:
    """A model with the noise that makes its predictions most likely.

    Attributes:
        unknowns: the free parameters.
        physical: all parameters and starts.
        noise: logarithms of the process variances (fractions of force and torque) and of the sensors' variance ratios.
        filtered: gains, whiteners and innovations.
        log_likelihood: of all data that count, and of what was measured of constants beforehand.
    """

    unknowns: Unknowns
    physical: Physical
    noise: Float[np.ndarray, " noise"]
    filtered: Filtered
    log_likelihood: float

    @property
    def random_force(self) -> float:
        """Rms of the random force that the predictor needs, as a fraction of `Scales.force`, in one sample."""
        return float(np.exp(0.5 * self.noise[0]))

    @property
    def random_torque(self) -> float:
        """Rms of the random torque on the arm, in the same way."""
        return float(np.exp(0.5 * self.noise[1]))


def compile_predictor(
    model: RTAC, data: Data, space: Space, prior: NoiseModel, substeps: Steps, *, noise: bool = True
) -> None:
    """Compile what `fit_predictor` will run, with or without the filter that it runs first; and run nothing."""
    unknowns = space.unconstrained(start=False)
    if noise:
        physical = (space.values, space.each_values, space.start)  # of the shapes that space.physical computes
        prepare_filter(model, data, space, physical, prior, first_noise(), substeps)
    whitener, gain = (
        to_jax(np.zeros((data.room, count, len(CHANNELS), data.experiments)))
        for count in (len(CHANNELS), len(model.states))
    )
    Passes(Arguments(model, data, space, whitener, gain, substeps)).prepare(unknowns)


def first_noise() -> np.ndarray:
    """Return the exponents of the noise at which a fit begins."""
    return np.array([_FIRST, _FIRST, 0.0, 0.0, 0.0])


def low_process_noise(exponents: Float[np.ndarray, " noise"]) -> Float[np.ndarray, " noise"]:
    """Return the exponents of the noise with random forces so small that they hide no effect."""
    return np.concatenate([np.minimum(exponents[:2], _LOW), exponents[2:]])


class Noise(NamedTuple):
    """The noise of the greatest likelihood.

    Attributes:
        exponents: logarithms of the process variances and of the sensors' variance ratios.
        log_likelihood: there, without the prior's part.
        filtered: the pass of the filter there.
        curvature: there or near there, to begin another fit with.
    """

    exponents: Float[np.ndarray, " noise"]
    log_likelihood: float
    filtered: Filtered
    curvature: Curvature | None


def fit_noise(
    model: RTAC,
    data: Data,
    space: Space,
    physical: Physical,
    prior: NoiseModel,
    first: np.ndarray | None,
    substeps: Steps,
    known: Curvature | None = None,
) -> Noise:
    """Fit the noise by maximum likelihood: Newton's steps with the expected curvature, damped where they lead uphill.

    The expected curvature is computed anew where the noise has moved; slopes only where a step gained. Where the noise is far
    off, most passes are over the beginning of all experiments only.

    Args:
        model: as `kalman` takes it, and so `data`, `space`, `physical` and `substeps`.
        data: of all experiments.
        space: of the model's parameters and starts.
        physical: parameters and starts.
        prior: noise to which the estimated noise is relative.
        first: exponents to begin from; by default the prior's.
        substeps: of the integrator in each sample.
        known: the curvature of another fit to these data.

    Source: Gupta and Mehra, IEEE Transactions on Automatic Control 19 (1974), scoring.
    """
    tight = np.concatenate([np.zeros(2), 1.0 / prior.doubt**2])

    def scored(at: np.ndarray, known: Curvature | None, data: Data = data) -> _Scored:
        return _Scored(at, score_noise(model, data, space, physical, prior, at, substeps), tight, known)

    def scored_in_part(at: np.ndarray, known: Curvature | None) -> _Scored:
        return scored(at, known, part)

    part = dataclasses.replace(data, length=jnp.asarray(data.samples // _PART))
    long = part.samples >= _FEWEST
    if first is None:
        begin = first_noise()
        at = _climbed(scored_in_part, scored_in_part(begin, None)).at if long else begin
        found = scored(at, known)
    else:
        found = scored(first, known)
        if long and np.isfinite(found.value) and found.promised(_moved(found, 0.0)) > _MUCH:
            nearer = scored(_climbed(scored_in_part, scored_in_part(first, None)).at, found.curvature)
            found = nearer if nearer.value < found.value else found
    found = _climbed(scored, found)
    value = found.passed.value
    return Noise(found.at, -value if np.isfinite(found.value) else -np.inf, found.passed.filtered, found.latest)


class _Scored:
    """A point of the noise, with the negative log-likelihood, slope and curvature there, prior included.

    Attributes:
        at: the noise.
        passed: the pass of the filter there.
        value: negative log-likelihood.
        latest: the curvature that is known, here or elsewhere.
    """

    def __init__(self, at: np.ndarray, passed: Passed, tight: np.ndarray, known: Curvature | None) -> None:
        self.at, self.passed, self.latest = at, passed, known
        self.value = passed.value + 0.5 * float(tight @ at**2)
        self._tight = tight

    @cached_property
    def slope(self) -> Float[np.ndarray, " noise"]:
        """Return the derivative by each noise."""
        return self.passed.slope() + self._tight * self.at

    @cached_property
    def curvature(self) -> Curvature:
        """Return the expected curvature of the likelihood, here or near here."""
        self.latest = self.passed.curvature(self.latest)
        return self.latest

    @property
    def information(self) -> Float[np.ndarray, "noise noise"]:
        """Return the curvature with that of the prior."""
        return self.curvature.information + np.diag(self._tight)

    def promised(self, trial: np.ndarray) -> float:
        """Return the gain in log-likelihood that the slope promises there."""
        return -float(self.slope @ (trial - self.at))


def _moved(here: _Scored, damping: float) -> Float[np.ndarray, " noise"]:
    """Return the noise after a Newton step within the bounds."""
    low = np.array([_LEAST] * 2 + [-6.0] * 3)
    high = np.array([*_MOST, 6.0, 6.0, 6.0])
    at, slope = here.at, here.slope
    free = np.flatnonzero(~((at <= low) & (slope > 0) | (at >= high) & (slope < 0)))
    information = here.information
    inner = information[free][:, free]
    # Where nothing counts, as where a body may always rest, nothing is known of any noise.
    least = 1e-9 * np.trace(information) + np.finfo(float).eps
    damped = inner + damping * np.diag(np.diagonal(inner)) + least * np.eye(len(free))
    move = np.zeros_like(at)
    move[free] = np.clip(-np.linalg.solve(damped, slope[free]), -_FAR, _FAR)
    return np.clip(at + move, low, high)


def _climbed(scored: Callable[[np.ndarray, Curvature | None], _Scored], here: _Scored) -> _Scored:
    """Climb by Newton's steps, and return the last point."""
    damping = 0.0
    for _ in range(_PASSES if np.isfinite(here.value) else 0):
        require_time()
        trial = _moved(here, damping)
        if here.promised(trial) < _LITTLE:
            break
        there = scored(trial, here.latest)
        gained = here.value - there.value
        if not gained > 0:
            damping = max(10.0 * damping, 1.0)
            continue
        here = there
        damping *= 0.1
        if gained < _LITTLE:
            break
    return here


def fit_trusted(
    model: RTAC, data: Data, space: Space, prior: NoiseModel, *, substeps: Steps, rounds: int = 10, off_bounds: float = 0.0,
    progress: Tell | None = None,
) -> tuple[Predictor, Data]:  # fmt: skip
    """Fit the predictor, and again from there `without_shaken` samples; return it and the data that counted."""
    options = {"substeps": substeps, "rounds": rounds, "progress": progress}
    found = fit_predictor(model, data, space, prior, off_bounds=off_bounds, **options)
    if not np.any(found.filtered.shaken):
        return found, data
    data = without_shaken(data, found.filtered)
    space = dataclasses.replace(space, values=found.physical[0], each_values=found.physical[1])
    return fit_predictor(model, data, space, prior, first=found.noise, **options), data


def fit_predictor(
    model: RTAC,
    data: Data,
    space: Space,
    prior: NoiseModel,
    *,
    substeps: Steps,
    first: np.ndarray | None = None,
    rounds: int = 10,
    off_bounds: float = 0.0,
    progress: Tell | None = None,
) -> Predictor:
    """Fit physics and noise in turn: gains are frozen while the physics is fitted to the innovations, then refreshed.

    Process noise that is large because the physics was wrong hides from the physics what it should mend. So where a
    round gains nothing, gains for less noise are tried, and kept if they make the data more likely. The states at the
    start are the filter's to mend, not the fit's: fitted with frozen gains they led astray.

    Args:
        model: that is fitted.
        data: that it predicts.
        space: of its unknowns, at the values to begin from.
        prior: noise to which the estimated noise is relative.
        substeps: Runge-Kutta steps per sample.
        first: exponents of the noise to begin from; by default the prior's.
        rounds: of physics and noise, at most.
        off_bounds: as `Space.unconstrained` takes it.
        progress: called with a line of text after every step.

    Source: Kristensen, Madsen and Jorgensen, Automatica 40 (2004); Ljung, System Identification (1999), section 7.
    """
    unknowns = space.unconstrained(start=False, off_bounds=off_bounds)
    physical = space.physical(unknowns)
    noise = fit_noise(model, data, space, physical, prior, first, substeps)
    failed = 0
    for _ in range(rounds):
        passed = noise.filtered
        if _LESS[failed] > 0:
            used = np.concatenate([np.maximum(noise.exponents[:2] - _LESS[failed], _LEAST), noise.exponents[2:]])
            passed = run_filter(model, data, space, physical, prior, used, substeps)
        arguments = Arguments(model, data, space, passed.whitener, passed.gain, substeps)
        solved = solve_bounded(unknowns, arguments, tolerance=1e-4, gain=_PHYSICS, most=20, progress=progress)
        trial = solved.unknowns
        moved = space.physical(trial)
        new = fit_noise(model, data, space, moved, prior, noise.exponents, substeps, noise.curvature)
        gained = new.log_likelihood - noise.log_likelihood + space.penalty(physical[0]) - space.penalty(moved[0])
        if gained > 0:
            unknowns, physical, noise = trial, moved, new
        failed = 0 if gained > _ENOUGH else failed + 1
        if failed == len(_LESS):
            break
    likelihood = noise.log_likelihood - space.penalty(physical[0])
    return Predictor(unknowns, physical, noise.exponents, noise.filtered, likelihood)
