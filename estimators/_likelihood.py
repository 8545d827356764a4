"""Prediction one sample ahead: sensor and process noise by maximum likelihood, physics by least squares on innovations."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import minimize

from estimators._bounds import solve_bounded
from estimators._kalman import Filtered, filtered, kalman
from estimators._levenberg_marquardt import Arguments
from estimators._problem import CHANNELS, Data, Space, Unknowns
from rtac_jax import RTAC, Scales
from rtac_jax._simulate import Steps
from rtac_jax.measurement import Experiment

# Random force and torque between these shares of the rms forces, as powers of e of their variance.
_LEAST, _MOST, _FIRST = np.log(1e-5**2), np.log(1.0**2), np.log(3e-3**2)
_PROCESS_UNIT = 0.3


@dataclasses.dataclass(frozen=True)
class NoiseModel:
    """What is known of the noise before the fit.

    Attributes:
        sensor: standard deviation of each channel, SI units.
        doubt: standard deviation of the logarithm of its variance.
        force, torque: sizes that scale the process noise [N, N m].
        interval: sample time [s].
        start_variance: of the states at the start.
    """

    sensor: Float[np.ndarray, " output"]
    doubt: Float[np.ndarray, " output"]
    force: float
    torque: float
    interval: float
    start_variance: Float[Array, "start experiment"]

    @classmethod
    def of(
        cls, levels: Mapping[str, float], experiments: Sequence[Experiment], scales: Scales, space: Space
    ) -> "NoiseModel":
        """From noise levels; a rest record or a stated level is trusted as far as its length allows."""
        resting = {c: sum(e.samples for e in experiments if e.kind == "rest" and c in e.outputs) for c in CHANNELS}
        doubt = [np.sqrt(2.0 / n) + 0.03 if (n := resting[c]) > 0 else 0.5 for c in CHANNELS]
        return cls(
            np.array([levels.get(c, 1.0) for c in CHANNELS]),
            np.array(doubt),
            scales.force,
            scales.torque,
            scales.sample_time,
            (space.start_scale * (1 - space.start_held)) ** 2,
        )


@dataclasses.dataclass(frozen=True)
class Predictor:
    """A model with the noise that makes its predictions most likely.

    Attributes:
        unknowns: the free parameters.
        physical: all parameters and starts.
        noise: logarithms of the process variances (shares of force and torque) and of the sensors' variance ratios.
        filtered: gains, whiteners and innovations.
        log_likelihood: of all data.
    """

    unknowns: Unknowns
    physical: tuple[Array, Array, Array]
    noise: Float[np.ndarray, " parameter"]
    filtered: Filtered
    log_likelihood: float

    @property
    def random_force(self) -> float:
        """Rms of the random force that the predictor needs, as a share of the rms spring force, in one sample."""
        return float(np.exp(0.5 * self.noise[0]))

    @property
    def random_torque(self) -> float:
        """Likewise of the random torque on the arm."""
        return float(np.exp(0.5 * self.noise[1]))


def _densities(noise: Any, prior: NoiseModel) -> tuple[Any, Any]:
    scale = jnp.asarray([prior.force**2, prior.torque**2]) * prior.interval
    density = jnp.exp(noise[:2]) * scale
    return density[0], density[1]


def _variances(noise: Any, prior: NoiseModel, data: Data) -> Array:
    return jnp.broadcast_to(
        (jnp.exp(noise[2:]) * jnp.asarray(prior.sensor) ** 2)[:, None], (len(CHANNELS), data.experiments)
    )


@eqx.filter_jit
def _slope(
    model: RTAC, data: Data, space: Space, physical: Any, noise: Array, scale: Array, sensor: Array, start: Array,
    substeps: Steps,
) -> tuple[Array, Array]:  # fmt: skip
    def negative(at: Array) -> Array:
        density = jnp.exp(at[:2]) * scale
        variance = jnp.broadcast_to((jnp.exp(at[2:]) * sensor**2)[:, None], (len(CHANNELS), data.experiments))
        found = kalman(
            model, data, space, physical, sensor_variance=variance, process=(density[0], density[1]),
            start_variance=start, substeps=substeps,
        )  # fmt: skip
        return -found.log_likelihood.sum()

    value, slope = jax.vmap(lambda t: jax.jvp(negative, (noise,), (t,)), out_axes=(None, 0))(jnp.eye(len(noise)))
    return value, slope


def fit_noise(
    model: RTAC, data: Data, space: Space, physical: Any, prior: NoiseModel, first: np.ndarray | None, substeps: Steps
) -> tuple[np.ndarray, float]:
    """Noise by maximum likelihood, and the log-likelihood there (without the prior's share)."""
    begin = np.array([_FIRST, _FIRST, 0.0, 0.0, 0.0]) if first is None else first
    scale = jnp.asarray([prior.force**2, prior.torque**2]) * prior.interval
    sensor = jnp.asarray(prior.sensor)

    def objective(at: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = _slope(
            model, data, space, physical, jnp.asarray(at), scale, sensor, prior.start_variance, substeps
        )
        pull = at[2:] / prior.doubt
        total = float(value) + 0.5 * float(pull @ pull)
        gradient = np.asarray(slope) + np.concatenate([np.zeros(2), pull / prior.doubt])
        if not np.isfinite(total):
            return 1e300, np.zeros_like(at)
        return total, gradient

    # In units in which the likelihood is about equally curved: a variance known from n samples has curvature n / 2.
    count = np.asarray(data.present).sum(axis=(0, 2))
    unit = np.concatenate([[_PROCESS_UNIT] * 2, 1.0 / np.sqrt(0.5 * count + 1.0 / prior.doubt**2)])
    low = np.array([_LEAST] * 2 + [-1.5] * 3) / unit
    high = np.array([_MOST] * 2 + [1.5] * 3) / unit

    def scaled(at: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = objective(at * unit)
        return value - reference, slope * unit

    reference = objective(begin)[0]
    found = minimize(
        scaled, begin / unit, jac=True, method="L-BFGS-B", bounds=np.stack([low, high], axis=1),
        options={"maxiter": 25, "maxfun": 30, "ftol": 0.0, "gtol": 0.3},
        callback=_Stalled(),
    )  # fmt: skip
    best, value = found.x * unit, float(found.fun) + reference
    pull = best[2:] / prior.doubt
    return best, -value + 0.5 * float(pull @ pull)


class _Stalled:
    """Stops the optimiser when two iterations gained less than matters in a log-likelihood."""

    def __init__(self) -> None:
        self.values: list[float] = []

    def __call__(self, intermediate_result: Any) -> None:
        self.values.append(float(intermediate_result.fun))
        if len(self.values) > 2 and self.values[-3] - self.values[-1] < 0.2:
            raise StopIteration


def fit_predictor(
    model: RTAC,
    data: Data,
    space: Space,
    prior: NoiseModel,
    *,
    substeps: Steps,
    first: np.ndarray | None = None,
    rounds: int = 2,
    progress: Any = None,
) -> Predictor:
    """Physics and noise in turn: gains are frozen while the physics is fitted to the innovations, then refreshed.

    Source: Kristensen, Madsen and Jorgensen, Automatica 40 (2004); Ljung, System Identification (1999), section 7.
    """
    unknowns = space.unconstrained(start=False)
    physical = space.physical(unknowns)
    noise, likelihood = fit_noise(model, data, space, physical, prior, first, substeps)
    for _ in range(rounds):
        passed = run_filter(model, data, space, physical, prior, noise, substeps)
        arguments = Arguments(model, data, space, passed.whitener, passed.gain, substeps)
        trial = solve_bounded(unknowns, arguments, tolerance=1e-4, most=20, progress=progress).unknowns
        moved = space.physical(trial)
        new_noise, new_likelihood = fit_noise(model, data, space, moved, prior, noise, substeps)
        gained = new_likelihood - likelihood
        if gained <= 0:
            break
        unknowns, physical, noise, likelihood = trial, moved, new_noise, new_likelihood
        if gained < 1.0:
            break
    passed = run_filter(model, data, space, physical, prior, noise, substeps)
    return Predictor(unknowns, physical, noise, passed, likelihood)


def run_filter(
    model: RTAC, data: Data, space: Space, physical: Any, prior: NoiseModel, noise: np.ndarray, substeps: Steps
) -> Filtered:
    """One pass with given noise."""
    at = jnp.asarray(noise)
    return filtered(
        model, data, space, physical, sensor_variance=_variances(at, prior, data), process=_densities(at, prior),
        start_variance=prior.start_variance, substeps=substeps,
    )  # fmt: skip
