"""The missing force and torque in time: smoothed from the innovations as forces that change slowly, or that swing."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.signal import periodogram

from estimators.core.data import Data
from estimators.core.parameter_space import Physical, Space
from estimators.prediction_error.force_smoother import likelihoods, linearised, smoothed
from rtac_jax import RTAC
from rtac_jax.measurement import Experiment
from rtac_jax.simulation import Steps

_PORTS = ("cart", "arm")
_UNITS = {"cart": "N", "arm": "N m"}
_CORRELATION_TIMES = (
    0.03,
    0.1,
    0.3,
    1.0,
)  # correlation times of the force that are tried, as fractions of the period of the motion
# Standard deviations of the force that are tried, as fractions of the rms force on the cart or motor torque.
_SHARES = (1e-4, 1e-3, 3e-3, 1e-2, 3e-2, 1e-1, 3e-1)
_STILL = 1e-7  # fraction of the force that stands for none
_RINGING = (1.0, 3.0, 10.0)  # correlation times that are tried of a force that swings, in its periods


@dataclasses.dataclass(frozen=True)
class LatentForce:
    """A smoothed force at one port as a function of time.

    Attributes:
        port: "cart" [N] or "arm" [N m].
        experiments: names.
        force, std: smoothed force and its standard deviation; a column for each experiment, NaN past its end.
        rms: of the force over all experiments, and its standard deviation.
        by_experiment: rms in each.
        frequency: at which it is strongest [rad/s].
        gain: in log-likelihood by allowing it, with no force at the other port.
    """

    port: str
    experiments: tuple[str, ...]
    force: Float[np.ndarray, "sample experiment"]
    std: Float[np.ndarray, "sample experiment"]
    rms: tuple[float, float]
    by_experiment: dict[str, float]
    frequency: float
    gain: float

    @property
    def unit(self) -> str:
        """Unit of the force, N or N m."""
        return _UNITS[self.port]

    @property
    def carried_by(self) -> tuple[str, ...]:
        """Experiments in which it is at least half as large as where it is largest, that one first."""
        order = sorted(self.by_experiment, key=lambda name: -self.by_experiment[name])
        return tuple(name for name in order if self.by_experiment[name] >= 0.5 * self.by_experiment[order[0]])

    def __str__(self) -> str:
        names = self.carried_by
        alike = len(names) == len(self.by_experiment) > 1
        most = f"in all experiments alike, most in {names[0]}" if alike else f"in {', '.join(names)}"
        return (
            f"{self.rms[0]:.2g} +- {self.rms[1]:.1g} {self.unit} rms on the {self.port}, strongest at "
            f"{self.frequency:.3g} rad/s and {most}"
        )


def latent_forces(
    model: RTAC,
    data: Data,
    space: Space,
    physical: Physical,
    gain: Array,
    substeps: Steps,
    experiments: Sequence[Experiment],
    *,
    sensor_variance: Float[np.ndarray, " output"],
    start_variance: Float[Array, "start experiment"],
    force: float,
    torque: float,
    frequency: float,
) -> tuple[LatentForce, ...]:
    """Smooth an Ornstein-Uhlenbeck force on the cart and one on the arm, of the sizes that the data make most likely.

    A port has one that swings instead, at the frequency at which the smoothed one is strongest, if that is likelier by more than
    the price of a parameter.

    Args:
        model: that leaves the force out.
        data: of all experiments.
        space: of the model's parameters.
        physical: parameters and starts of the predictor with this gain.
        gain: of the predictor, [sample state output experiment].
        substeps: of the integrator in each sample.
        experiments: that the data were made from.
        sensor_variance: of each output's noise, SI units squared.
        start_variance: of the states at the start; what they are off by is no force.
        force: size that scales the force on the cart [N].
        torque: size that scales the torque on the arm [N m].
        frequency: of the motion [rad/s].

    Returns:
        The larger gain in likelihood first; ports that nothing shows are left out.

    Source: Rogers and Friis, Mechanical Systems and Signal Processing 166 (2022); smoother of Bierman, Automatica 9 (1973), after
    Bryson and Frazier; the force that swings: Solin and Sarkka, Explicit link between periodic covariance functions and state
    space models (2014).
    """
    scale = np.array([force, torque])
    still = _STILL * scale
    variance = jnp.broadcast_to(jnp.asarray(sensor_variance)[:, None], (len(sensor_variance), data.experiments))
    linear = linearised(model, data, space, physical, gain, variance, start_variance, jnp.asarray(substeps))

    def likelihood(fractions: np.ndarray, correlation_time: float, swing: float) -> tuple[float, np.ndarray]:
        """Return the log-likelihood without a force, and with one at each port of each size (a row of fractions a port)."""
        trials = np.broadcast_to(still, (1 + fractions.size, 2)).copy()
        for port in range(2):
            trials[1 + port * fractions.shape[1] :, port][: fractions.shape[1]] = fractions[port] * scale[port]
        values = np.asarray(
            likelihoods(linear, data, gain, jnp.asarray(trials), jnp.asarray(correlation_time), jnp.asarray(swing))
        )
        return float(values[0]), values[1:].reshape(2, -1)

    def likeliest(times: np.ndarray, swing: float) -> _Likeliest:
        coarse = np.broadcast_to(_SHARES, (2, len(_SHARES)))
        each = [likelihood(coarse, time, swing)[1] for time in times]
        best = max(range(len(times)), key=lambda n: each[n].max())
        correlation_time, middle = float(times[best]), coarse[0, each[best].argmax(axis=1)]
        fine = middle[:, None] * np.geomspace(0.25, 4.0, len(_SHARES))
        none, by_port = likelihood(fine, correlation_time, swing)
        gained = by_port.max(axis=1) - none
        chosen = np.take_along_axis(fine, by_port.argmax(axis=1)[:, None], axis=1)[:, 0] * scale
        chosen = jnp.asarray(np.where(gained > 0, chosen, still))
        mean, variance = smoothed(linear, data, gain, chosen, jnp.asarray(correlation_time), jnp.asarray(swing))
        return _Likeliest(gained, correlation_time, np.asarray(mean), np.asarray(variance))

    slow = likeliest(np.array(_CORRELATION_TIMES) * 2 * np.pi / frequency, 0.0)
    strongest = _strongest(slow.mean[:, int(np.argmax(slow.gained))], experiments)
    swinging = likeliest(np.array(_RINGING) * 2 * np.pi / strongest, strongest)
    price = 0.5 * float(np.log(np.sum(np.asarray(data.present))))  # of the frequency
    lengths = [e.samples for e in experiments]
    found = []
    for port, name in enumerate(_PORTS):
        best = swinging if swinging.gained[port] > slow.gained[port] + price else slow
        if best.gained[port] <= 0:
            continue
        at, std = best.mean[:, port].copy(), np.sqrt(np.maximum(best.variance[:, port], 0.0))
        for column, length in enumerate(lengths):
            at[length:, column] = np.nan
            std[length:, column] = np.nan
        # Between what the data show and what they leave room for: of the latter the assumed spectrum decides.
        seen, possible = np.sqrt(np.nanmean(at**2)), np.sqrt(np.nanmean(at**2 + std**2))
        rms = float(0.5 * (seen + possible))
        measured = np.isfinite(at).sum(axis=0) @ np.array([e.sample_time for e in experiments])  # s
        independent = float(measured) / best.correlation_time
        doubt = float(0.5 * (possible - seen) + rms / np.sqrt(2 * max(independent, 1.0)))
        found.append(
            LatentForce(
                name,
                tuple(e.name for e in experiments),
                at,
                std,
                (rms, doubt),
                {e.name: float(np.sqrt(np.nanmean(at[:, i] ** 2))) for i, e in enumerate(experiments)},
                _strongest(at, experiments),
                float(best.gained[port]),
            )
        )
    return tuple(sorted(found, key=lambda one: -one.gain))


class _Likeliest(NamedTuple):
    """The likeliest forces of one kind of spectrum.

    Attributes:
        gained: log-likelihood by a force at each port.
        correlation_time: correlation time [s].
        mean, variance: of the forces given all measurements.
    """

    gained: Float[np.ndarray, " port"]
    correlation_time: float
    mean: Float[np.ndarray, "sample port experiment"]
    variance: Float[np.ndarray, "sample port experiment"]


def _strongest(force: np.ndarray, experiments: Sequence[Experiment]) -> float:
    grid = np.geomspace(0.5, np.pi / max(e.sample_time for e in experiments), 400)
    total = np.zeros_like(grid)
    for column, e in enumerate(experiments):
        frequency, power = periodogram(force[: e.samples, column], 1 / e.sample_time, "hann")
        total += e.samples * e.sample_time * np.interp(grid, 2 * np.pi * frequency, power)
    return float(grid[np.argmax(total)])
