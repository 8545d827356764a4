"""Passes of the filter at given noise, with and without the derivatives of the likelihood by it."""

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from estimators.core.data import CHANNELS, Data
from estimators.core.padded_experiments import experiments_at, padded
from estimators.core.parameter_space import Physical, Space
from estimators.core.piecewise_triangle import LONG
from estimators.prediction_error.ekf import Filtered, Linearised, kalman
from estimators.prediction_error.noise_model import NoiseModel
from estimators.prediction_error.noise_score import noise_information, noise_slope
from rtac_jax import RTAC
from rtac_jax.programs import program
from rtac_jax.simulation import Steps, equations_of

# How far in the logarithm of a variance the expected curvature is taken for the same: it sets the steps, and not where they end.
_NEAR = 0.5


class Curvature(NamedTuple):
    """The expected curvature of the negative log-likelihood (Fisher), and the noise at which it was computed."""

    at: Float[np.ndarray, " noise"]
    information: Float[np.ndarray, "noise noise"]


class Passed:
    """A pass of the filter, and the derivatives of the likelihood by the noise, computed when they are asked for.

    Attributes:
        filtered: the pass.
        value: negative log-likelihood.
    """

    def __init__(
        self,
        noise: Float[np.ndarray, " noise"],
        filtered: Filtered,
        linear: Linearised,
        length: Array,
        experiments: int,
    ) -> None:
        """Keep a pass.

        Args:
            noise: at which it was.
            filtered: its result, of experiments that may be padded.
            linear: the linear model along it.
            length: samples of the pass.
            experiments: number of those that count, the first.
        """
        self.filtered, self._noise = _first(filtered, experiments), noise
        self.value = -float(self.filtered.log_likelihood.sum())
        self._given, self._count = (filtered, linear, length), experiments

    def slope(self) -> Float[np.ndarray, " noise"]:
        """Return the derivatives of the value by the logarithms of the variances."""
        return np.asarray(_slope(*self._given))[..., : self._count].sum(-1)

    def curvature(self, known: Curvature | None = None) -> Curvature:
        """Return the expected curvature here, or what is known of these data where that is near."""
        if known is not None and np.max(np.abs(known.at - self._noise)) <= _NEAR:
            return known
        return Curvature(self._noise, np.asarray(_information(*self._given))[..., : self._count].sum(-1))


@program
def _filter(*arguments: Any) -> tuple[Filtered, Linearised]:
    """Run the filter; see `_arguments`."""
    return _filtered(*arguments)


@program
def _filter_alone(*arguments: Any) -> Filtered:
    """Run the filter, and keep nothing of the linear model, which takes as much memory as the filter's own; see `_arguments`."""
    return _filtered(*arguments)[0]


@program
def _likelihood(*arguments: Any) -> Float[Array, " experiment"]:
    """Run the filter for the log-likelihood alone; see `_arguments`."""
    return _filtered(*arguments)[0].log_likelihood


_slope, _information = program(noise_slope), program(noise_information)


def _filtered(
    model: RTAC, data: Data, space: Space, physical: Physical, noise: Array, scale: Array, sensor: Array, start: Array,
    substeps: Steps,
) -> tuple[Filtered, Linearised]:  # fmt: skip
    density = jnp.exp(noise[:2]) * scale
    variance = (jnp.exp(noise[2:]) * sensor**2)[:, None]
    return kalman(
        model, data, space, physical, sensor_variance=jnp.broadcast_to(variance, (len(CHANNELS), data.experiments)),
        process=(density[0], density[1]), start_variance=start, substeps=substeps,
    )  # fmt: skip


def run_filter(
    model: RTAC, data: Data, space: Space, physical: Physical, prior: NoiseModel, noise: np.ndarray, substeps: Steps
) -> Filtered:
    """Run the filter's pass at given noise; where experiments are long, by a program of its own, which takes less memory."""
    arguments = _arguments(model, data, space, physical, prior, noise, substeps)
    found = _filter_alone(*arguments) if data.room >= LONG else _filter(*arguments)[0]
    return _first(found, data.experiments)


def score_noise(
    model: RTAC, data: Data, space: Space, physical: Physical, prior: NoiseModel, noise: np.ndarray, substeps: Steps
) -> Passed:
    """Run the filter's pass at given noise, with the derivatives of its likelihood by that."""
    filtered, linear = _filter(*_arguments(model, data, space, physical, prior, noise, substeps))
    return Passed(noise, filtered, linear, data.length, data.experiments)


def negative_log_likelihood(
    model: RTAC, data: Data, space: Space, physical: Physical, prior: NoiseModel, noise: np.ndarray, substeps: Steps
) -> float:
    """Return the negative log-likelihood at given noise: the value of `score_noise`, without the derivatives."""
    found = _likelihood(*_arguments(model, data, space, physical, prior, noise, substeps))
    return -float(found[: data.experiments].sum())


def prepare_filter(
    model: RTAC, data: Data, space: Space, physical: Physical, prior: NoiseModel, noise: np.ndarray, substeps: Steps
) -> None:
    """Compile the filter of `score_noise`, and run nothing."""
    _filter.prepare(*_arguments(model, data, space, physical, prior, noise, substeps))


def _arguments(
    model: RTAC, data: Data, space: Space, physical: Physical, prior: NoiseModel, noise: np.ndarray, substeps: Steps
) -> tuple[Any, ...]:
    """Return what a pass is given, its experiments `padded`."""
    scale = jnp.asarray(np.array([prior.force**2, prior.torque**2]) * prior.interval)
    sensor, (shared, each, at) = jnp.asarray(prior.sensor), physical
    data, space, each, at, start = padded(data, space.at_given_values(), each, at, prior.start_variance)
    physical = (shared, each, at)
    return equations_of(model), data, space, physical, jnp.asarray(noise), scale, sensor, start, substeps


def _first(filtered: Filtered, experiments: int) -> Filtered:
    """Return the pass of the first experiments, without what they were padded by."""
    if len(filtered.log_likelihood) == experiments:
        return filtered
    return experiments_at(filtered, slice(experiments))


def without_shaken(data: Data, filtered: Filtered) -> Data:
    """Return the data without the stick-slip ambiguous samples, at which random forces may overcome dry friction.

    There the filter takes for a straight line what is a step, and how likely it finds the data changes more with the level of
    the friction than with the rest of the physics: counted, such samples make the level too low.
    """
    return dataclasses.replace(data, trusted=data.trusted * (1.0 - filtered.shaken))


def all_trusted(data: Data) -> Data:
    """Return the data, of which every sample counts."""
    return dataclasses.replace(data, trusted=jnp.ones_like(data.trusted))
