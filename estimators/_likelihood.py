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
from estimators._compile import compile_only
from estimators._kalman import Filtered, kalman
from estimators._levenberg_marquardt import Arguments, factor
from estimators._problem import CHANNELS, Data, Space, Unknowns
from rtac_jax import RTAC, Scales
from rtac_jax._simulate import Steps
from rtac_jax.measurement import Experiment

# Random force and torque between these shares of the rms forces, as powers of e of their variance.
# A force beyond the rms force comes from wrong physics and would keep it wrong; a motor's torque is small beside what can
# shake it.
_LEAST, _FIRST = np.log(1e-5**2), np.log(3e-3**2)
_MOST = (np.log(1.0**2), np.log(10.0**2))
_PROCESS_UNIT = 0.3
_LESS = (0.0, 4.0)  # by how much in the logarithm of the variance
_ENOUGH = 1.0  # gain in log-likelihood that is worth another round


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
            start_variance(space),
        )

    def starting(self, space: Space) -> "NoiseModel":
        """The same for a model with other states."""
        return dataclasses.replace(self, start_variance=start_variance(space))


def start_variance(space: Space) -> Float[Array, "start experiment"]:
    """Variance of the states at the start; none where they are held."""
    return jnp.asarray((np.asarray(space.start_scale) * (1 - np.asarray(space.start_held))) ** 2)


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


@eqx.filter_jit
def _pass(
    model: RTAC, data: Data, space: Space, physical: Any, noise: Array, scale: Array, sensor: Array, start: Array,
    substeps: Steps,
) -> tuple[Array, Array, Filtered]:  # fmt: skip
    """Negative log-likelihood, its slope by the noise, and the filter's pass; one compiled function for all three."""

    def negative(at: Array) -> tuple[Array, Filtered]:
        density = jnp.exp(at[:2]) * scale
        variance = jnp.broadcast_to((jnp.exp(at[2:]) * sensor**2)[:, None], (len(CHANNELS), data.experiments))
        found = kalman(
            model, data, space, physical, sensor_variance=variance, process=(density[0], density[1]),
            start_variance=start, substeps=substeps,
        )  # fmt: skip
        return -found.log_likelihood.sum(), found

    return jax.vmap(lambda t: jax.jvp(negative, (noise,), (t,), has_aux=True), out_axes=(None, 0, None))(
        jnp.eye(len(noise))
    )


def run_filter(
    model: RTAC, data: Data, space: Space, physical: Any, prior: NoiseModel, noise: np.ndarray, substeps: Steps
) -> tuple[float, np.ndarray, Filtered]:
    """Negative log-likelihood at given noise, its slope, and the filter's pass."""
    value, slope, found = _pass(*_arguments(model, data, space, physical, prior, noise, substeps))
    return float(value), np.asarray(slope), found


def _arguments(
    model: RTAC, data: Data, space: Space, physical: Any, prior: NoiseModel, noise: np.ndarray, substeps: Steps
) -> tuple[Any, ...]:
    scale = jnp.asarray(np.array([prior.force**2, prior.torque**2]) * prior.interval)
    sensor = jnp.asarray(prior.sensor)
    return model, data, space, physical, jnp.asarray(noise), scale, sensor, prior.start_variance, substeps


def compile_predictor(model: RTAC, data: Data, space: Space, prior: NoiseModel, substeps: Steps) -> None:
    """Compile what `fit_predictor` will run, and run nothing."""
    unknowns = space.unconstrained(start=False)
    physical = (space.values, space.each_values, space.start)  # of the shapes that space.physical computes
    compile_only(_pass, *_arguments(model, data, space, physical, prior, _begin(), substeps))
    whitener, gain = (
        jnp.asarray(np.zeros((data.samples, count, len(CHANNELS), data.experiments)))
        for count in (len(CHANNELS), len(model.states))
    )
    compile_only(factor, unknowns, Arguments(model, data, space, whitener, gain, substeps))


def _begin() -> np.ndarray:
    return np.array([_FIRST, _FIRST, 0.0, 0.0, 0.0])


def fit_noise(
    model: RTAC, data: Data, space: Space, physical: Any, prior: NoiseModel, first: np.ndarray | None, substeps: Steps
) -> tuple[np.ndarray, float]:
    """Noise by maximum likelihood, and the log-likelihood there (without the prior's share)."""
    begin = _begin() if first is None else first

    def objective(at: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope, _ = run_filter(model, data, space, physical, prior, at, substeps)
        pull = at[2:] / prior.doubt
        total = value + 0.5 * float(pull @ pull)
        gradient = slope + np.concatenate([np.zeros(2), pull / prior.doubt])
        if not np.isfinite(total):
            return 1e300, np.zeros_like(at)
        return total, gradient

    # In units in which the likelihood is about equally curved: a variance known from n samples has curvature n / 2.
    count = np.asarray(data.present).sum(axis=(0, 2))
    unit = np.concatenate([[_PROCESS_UNIT] * 2, 1.0 / np.sqrt(0.5 * count + 1.0 / prior.doubt**2)])
    low = np.array([_LEAST] * 2 + [-6.0] * 3) / unit
    high = np.array([*_MOST, 6.0, 6.0, 6.0]) / unit

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
    rounds: int = 10,
    progress: Any = None,
) -> Predictor:
    """Physics and noise in turn: gains are frozen while the physics is fitted to the innovations, then refreshed.

    Process noise that is large because the physics was wrong hides from the physics what it should mend. So where a
    round gains nothing, gains for less noise are tried, and kept if they make the data more likely.
    The states at the start are the filter's to mend, not the fit's: fitted with frozen gains they led astray.

    Source: Kristensen, Madsen and Jorgensen, Automatica 40 (2004); Ljung, System Identification (1999), section 7.
    """
    unknowns = space.unconstrained(start=False)
    physical = space.physical(unknowns)
    noise, likelihood = fit_noise(model, data, space, physical, prior, first, substeps)
    failed = 0
    for _ in range(rounds):
        less = _LESS[failed]
        used = np.concatenate([np.maximum(noise[:2] - less, _LEAST), noise[2:]])
        passed = run_filter(model, data, space, physical, prior, used, substeps)[2]
        arguments = Arguments(model, data, space, passed.whitener, passed.gain, substeps)
        trial = solve_bounded(unknowns, arguments, tolerance=1e-4, most=20, progress=progress).unknowns
        moved = space.physical(trial)
        new_noise, new_likelihood = fit_noise(model, data, space, moved, prior, noise, substeps)
        gained = new_likelihood - likelihood
        if gained > 0:
            unknowns, physical, noise, likelihood = trial, moved, new_noise, new_likelihood
        failed = 0 if gained > _ENOUGH else failed + 1
        if failed == len(_LESS):
            break
    passed = run_filter(model, data, space, physical, prior, noise, substeps)[2]
    return Predictor(unknowns, physical, noise, passed, likelihood)
