"""Smoothed initial states: the most likely start of each experiment, random forces counted."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from estimators.prediction_error.filter_pass import all_trusted, run_filter
from estimators.prediction_error.fit import PredictorFit

_STEPS = 12
_FIRST = 0.1  # standard deviations beforehand, over which the first slopes are taken
_SPAN = 0.5  # standard deviations afterwards, over which the others are
_DAMPING = (1e-2, 10.0)  # at first, and by how much it grows or falls
_ENOUGH = 1e-2  # gain in log-likelihood, predicted or made, that is worth another step
_STALLED = 3  # steps without such a gain, each more damped than the one before, after which it stops


def smoothed_start(fit: PredictorFit) -> Float[np.ndarray, "start experiment"]:
    """Return the states at the start of each experiment, SI units, of largest probability given all measurements.

    Damped Gauss-Newton steps on the innovations of filters that know their start for sure, for all experiments side by side.
    Slopes are differences over a finite span: a body that dry friction holds shows no derivative, but it does show where it
    would begin to slide.

    Source: maximum a posteriori smoothing; Bell, SIAM J. Optim. 4 (1994), as a Gauss-Newton method.
    """
    a = fit.problem.arguments
    data = all_trusted(a.data)  # a body that rests in the first samples tells where it begins
    shared, each, first = (np.asarray(part) for part in a.space.physical(fit.problem.unknowns))
    deviation = np.sqrt(np.asarray(fit.prior.start_variance))
    sure = dataclasses.replace(fit.prior, start_variance=jnp.zeros_like(fit.prior.start_variance))

    def looked_at(moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the log of the probability, and the innovations, after moves in standard deviations beforehand."""
        physical: Any = (jnp.asarray(shared), jnp.asarray(each), jnp.asarray(first + deviation * moved))
        passed = run_filter(a.model, data, a.space, physical, sure, fit.noise_exponents, a.substeps)
        likelihood = np.asarray(passed.log_likelihood) - 0.5 * np.sum(moved**2, axis=0)
        return np.where(np.isfinite(likelihood), likelihood, -np.inf), np.nan_to_num(
            np.asarray(passed.innovations), posinf=0.0, neginf=0.0
        )

    here = np.zeros_like(first)
    free = deviation > 0
    span = np.where(free, _FIRST, 0.0)
    damping = np.full(first.shape[1], _DAMPING[0])
    value, error = looked_at(here)
    stalled = 0
    for _ in range(_STEPS):
        slopes = []
        for row in range(len(first)):
            aside = np.zeros_like(here)
            aside[row] = span[row]
            slopes.append((looked_at(here + aside)[1] - error) / np.where(span[row] > 0, span[row], 1.0))
        jacobian = np.stack(slopes, axis=-1)  # sample, output, experiment, row
        information = np.einsum("soer,soeq->erq", jacobian, jacobian) + np.eye(len(first))
        gradient = np.einsum("soer,soe->er", jacobian, error) + here.T
        scaled = information * (1 + damping[:, None, None] * np.eye(len(first)))
        step = np.linalg.solve(scaled, gradient[..., None])[..., 0]
        if np.max(0.5 * np.sum(gradient * step, axis=1)) < _ENOUGH:
            break
        there = np.where(free, here - step.T, 0.0)
        new_value, new_error = looked_at(there)
        better = new_value > value
        gained = float(np.max(np.where(better, new_value - value, 0.0)))
        here, value = np.where(better, there, here), np.where(better, new_value, value)
        error = np.where(better, new_error, error)
        damping = np.where(better, damping / _DAMPING[1], damping * _DAMPING[1])
        afterwards = np.sqrt(np.diagonal(np.linalg.inv(information), axis1=1, axis2=2)).T
        span = np.where(free, np.where(better, _SPAN * afterwards, 0.5 * span), 0.0)
        stalled = 0 if gained > _ENOUGH else stalled + 1
        if stalled == _STALLED:
            break
    return first + deviation * here
