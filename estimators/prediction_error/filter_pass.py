"""Passes of the filter at given noise, with and without the derivatives of the likelihood by it."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from estimators.core.data import CHANNELS, Data
from estimators.core.parameter_space import Space
from estimators.core.piecewise_triangle import LONG
from estimators.prediction_error.ekf import Filtered, kalman
from estimators.prediction_error.noise_model import NoiseModel
from estimators.prediction_error.noise_quadrature import ByNoise
from rtac_jax import RTAC
from rtac_jax.programs import program
from rtac_jax.simulation import Steps


class Passed(NamedTuple):
    """A pass of the filter, and the derivatives of the likelihood by the noise.

    Attributes:
        value: negative log-likelihood.
        slope: of that, by the logarithms of the variances.
        information: expected curvature (Fisher).
        filtered: the pass.
    """

    value: Array
    slope: Float[Array, " noise"]
    information: Float[Array, "noise noise"]
    filtered: Filtered


# Experiments from which on a filter passes through all of them abreast, a column for each, instead of one after the other.
_ABREAST = 16


@program
def _pass(*arguments: Any) -> Passed:
    """Run the filter and its derivatives as one compiled function; see `_arguments`."""
    found, slopes = _filtered(*arguments, by_noise=True)
    assert slopes is not None  # since they were asked for
    return Passed(-found.log_likelihood.sum(), slopes.slope.sum(-1), slopes.information.sum(-1), found)


@program
def _filter(*arguments: Any) -> Filtered:
    """Run the filter alone; see `_arguments`."""
    return _filtered(*arguments, by_noise=False)[0]


@program
def _negative_log_likelihood(*arguments: Any) -> Float[Array, ""]:
    """Run the filter for the negative log-likelihood alone; see `_arguments`."""
    return -_filtered(*arguments, by_noise=False)[0].log_likelihood.sum()


def _filtered(
    model: RTAC, data: Data, space: Space, physical: Any, noise: Array, scale: Array, sensor: Array, start: Array,
    substeps: Steps, *, by_noise: bool,
) -> tuple[Filtered, ByNoise | None]:  # fmt: skip
    density = jnp.exp(noise[:2]) * scale
    variance = (jnp.exp(noise[2:]) * sensor**2)[:, None]

    def passed(data: Data, each: Array, begun: Array, start: Array) -> tuple[Filtered, ByNoise | None]:
        return kalman(
            model, data, space, (physical[0], each, begun),
            sensor_variance=jnp.broadcast_to(variance, (len(CHANNELS), data.experiments)),
            process=(density[0], density[1]), start_variance=start, substeps=substeps, by_noise=by_noise,
        )  # fmt: skip

    given = (data, physical[1], physical[2], start)
    if data.experiments >= _ABREAST:
        return passed(*given)
    # Few columns fill no vectors, and what is computed for one alone is shorter code.
    columns = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0) if np.ndim(x) else jnp.full(data.experiments, x), given)
    widths = jax.tree.map(np.ndim, given)
    found = jax.lax.map(lambda one: passed(*jax.tree.map(lambda x, n: x[..., None] if n else x, one, widths)), columns)
    return jax.tree.map(lambda x: jnp.moveaxis(x[..., 0], 0, -1), found)


def run_filter(
    model: RTAC, data: Data, space: Space, physical: Any, prior: NoiseModel, noise: np.ndarray, substeps: Steps
) -> Passed:
    """Run the filter's pass at given noise."""
    return _pass(*_arguments(model, data, space, physical, prior, noise, substeps))


def filter_alone(
    model: RTAC, data: Data, space: Space, physical: Any, prior: NoiseModel, noise: np.ndarray, substeps: Steps
) -> Filtered:
    """Return what `run_filter` filters, without the derivatives by the noise where experiments are long.

    These take two thirds of a pass, and a program without them some seconds to compile.
    """
    arguments = _arguments(model, data, space, physical, prior, noise, substeps)
    return _filter(*arguments) if data.room >= LONG else _pass(*arguments).filtered


def negative_log_likelihood(
    model: RTAC, data: Data, space: Space, physical: Any, prior: NoiseModel, noise: np.ndarray, substeps: Steps
) -> float:
    """Return the negative log-likelihood at given noise: `run_filter`'s value, without the derivatives by the noise."""
    return float(_negative_log_likelihood(*_arguments(model, data, space, physical, prior, noise, substeps)))


def _arguments(
    model: RTAC, data: Data, space: Space, physical: Any, prior: NoiseModel, noise: np.ndarray, substeps: Steps
) -> tuple[Any, ...]:
    scale = jnp.asarray(np.array([prior.force**2, prior.torque**2]) * prior.interval)
    sensor = jnp.asarray(prior.sensor)
    return model, data, space, physical, jnp.asarray(noise), scale, sensor, prior.start_variance, substeps


def prepare_filter(
    model: RTAC, data: Data, space: Space, physical: Any, prior: NoiseModel, noise: np.ndarray, substeps: Steps
) -> None:
    """Compile what `run_filter` runs, and run nothing."""
    _pass.prepare(*_arguments(model, data, space, physical, prior, noise, substeps))


def without_shaken(data: Data, filtered: Filtered) -> Data:
    """Return the data without the stick-slip ambiguous samples, at which random forces may overcome dry friction.

    There the filter takes for a straight line what is a step, and how likely it finds the data changes more with the level of
    the friction than with the rest of the physics: counted, such samples make the level too low.
    """
    return dataclasses.replace(data, trusted=data.trusted * (1.0 - filtered.shaken))


def all_trusted(data: Data) -> Data:
    """Return the data, of which every sample counts."""
    return dataclasses.replace(data, trusted=jnp.ones_like(data.trusted))
