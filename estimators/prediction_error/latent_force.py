"""The missing force and torque in time: smoothed from the innovations as forces that change slowly, or that swing."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.signal import periodogram

from estimators.core.data import Data
from estimators.core.parameter_space import Space
from estimators.core.residual import states_at_start
from estimators.prediction_error.ekf import Wander, start_places, wandering
from rtac_jax import RTAC
from rtac_jax.measurement import Experiment
from rtac_jax.programs import program
from rtac_jax.simulation import Steps, advance, trajectories
from rtac_jax.time_loop import time_loop

_PORTS = ("cart", "arm")
_UNITS = {"cart": "N", "arm": "N m"}
_CORRELATION_TIMES = (
    0.03,
    0.1,
    0.3,
    1.0,
)  # correlation times of the force that are tried, as fractions of the period of the motion
# Standard deviations of the force that are tried, as fractions of the rms spring force or motor torque.
_SHARES = (1e-4, 1e-3, 3e-3, 1e-2, 3e-2, 1e-1, 3e-1)
_STILL = 1e-7  # fraction of the force that stands for none
_ABREAST = 16  # experiments, each with a force of its own size, that are filtered at once: more at once take longer
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
    physical: tuple[Array, Array, Array],
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
    linear = _linearised(model, data, space, physical, gain, variance, start_variance, jnp.asarray(substeps))

    def likelihood(fractions: np.ndarray, correlation_time: float, swing: float) -> tuple[float, np.ndarray]:
        """Return the log-likelihood without a force, and with one at each port of each size (a row of fractions a port)."""
        trials = np.broadcast_to(still, (1 + fractions.size, 2)).copy()
        for port in range(2):
            trials[1 + port * fractions.shape[1] :, port][: fractions.shape[1]] = fractions[port] * scale[port]
        values = np.asarray(
            _likelihoods(linear, data, gain, jnp.asarray(trials), jnp.asarray(correlation_time), jnp.asarray(swing))
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
        mean, variance = _smoothed(linear, data, gain, chosen, jnp.asarray(correlation_time), jnp.asarray(swing))
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


class _Linear(eqx.Module):
    """The model linearised along the predicted motion: arrays with sample first and experiment last."""

    transition: Float[Array, "sample state state experiment"]
    push: Float[Array, "sample state port experiment"]
    shown: Float[Array, "sample output state experiment"]
    error: Float[Array, "sample output experiment"]
    wander: Wander
    begin: Float[Array, "state experiment"]
    interval: Float[Array, " experiment"]


@program
def _linearised(
    model: RTAC,
    data: Data,
    space: Space,
    physical: tuple[Array, Array, Array],
    gain: Array,
    variance: Array,
    start_variance: Array,
    substeps: Steps,
) -> _Linear:
    shared, each, start = physical
    placed = model.with_values(dict(zip(space.names, shared, strict=True)) | dict(zip(space.each, each, strict=True)))
    excitation = placed.driven(data.excitation)
    predicted = trajectories(
        placed, states_at_start(placed, start, data.excitation), data.excitation, room=data.room, samples=data.length,
        substeps=substeps,
        measured=(data.values, data.present), gain=gain, states=True,
    )  # fmt: skip
    count, shape = predicted.shape[1], predicted[:, 0].shape

    def outputs(*state: Array) -> Array:
        return jnp.stack([jnp.broadcast_to(y, shape) for y in placed.outputs(state)])

    state = tuple(predicted[:, i] for i in range(count))
    error = (data.values - jnp.moveaxis(outputs(*state), 0, 1)) * data.present
    corrected = tuple(x + jnp.sum(gain[:, i] * error, axis=1) for i, x in enumerate(state))
    inputs = [
        None if known is None else tuple(known[:, p] for p in range(known.shape[1]))
        for known in (excitation.current, excitation.force)
    ]

    def onward(*at: Array) -> Array:
        return jnp.stack(advance(placed, at, inputs[0], inputs[1], excitation, substeps=substeps))

    def by_state(function: Callable[..., Array], at: tuple[Array, ...]) -> Array:
        """Return derivatives [sample row state experiment]; one map over directions, or each would be compiled by itself."""
        unit = tuple(jnp.broadcast_to(row[:, None, None], (count, *shape)) for row in jnp.eye(count))
        slopes = jax.vmap(lambda *along: jax.jvp(function, at, along)[1])(*unit)
        return jnp.transpose(slopes, (2, 1, 0, 3))

    transition, shown = by_state(onward, corrected), by_state(outputs, state)
    cart_cart, cart_arm, arm_arm = (
        jnp.broadcast_to(x, shape) for x in placed.pushes(corrected, excitation.arm_free, excitation.cart_free)
    )
    nothing = jnp.zeros(shape)
    rest = [nothing] * (count - 4)
    columns = [jnp.stack([nothing, a, nothing, b, *rest]) for a, b in ((cart_cart, cart_arm), (cart_arm, arm_arm))]
    push = jnp.transpose(jnp.stack(columns, axis=1), (2, 0, 1, 3))
    push = 0.5 * excitation.sample_time * (push + jnp.einsum("sabe,sbpe->sape", transition, push))
    wander = wandering(placed, variance, excitation.sample_time)
    begin = wander.stationary.at[jnp.asarray(start_places(model))].add(start_variance)
    return _Linear(transition, push, shown, error, wander, begin, excitation.sample_time)


class _Update(NamedTuple):
    """The update by one output at one sample.

    Attributes:
        shows: what the output shows of the states.
        gain: of the filter.
        weight: reciprocal variance of the prediction; zero where nothing was measured.
        off: by which the prediction misses the output.
    """

    shows: Array
    gain: Array
    weight: Array
    off: Array


class _Filtered(NamedTuple):
    """What a filter knows at every sample, and what a smoother needs to go back.

    Attributes:
        mean, spread: of the states after all outputs of the sample.
        forward: transition to the next sample.
        updates: by each output.
        lasts: whether the experiment has a next sample.
        likelihood: logarithm of it, of the outputs that count.
    """

    mean: Array
    spread: Array
    forward: Array
    updates: tuple[_Update, ...]
    lasts: Array
    likelihood: Array


def _filter(
    linear: _Linear,
    data: Data,
    gain: Array,
    size: Array,
    correlation_time: Any,
    swing: Any,
    keep_of: Callable[[_Filtered], Any],
) -> Any:
    """Filter the prediction errors with the two forces as further states, and return of every sample what is kept.

    A force is the real part of a phasor that turns at `swing` [rad/s] and forgets within `correlation_time` [s].
    """
    count, experiments = linear.transition.shape[1], linear.error.shape[2]
    keep = jnp.exp(-linear.interval / correlation_time)
    turn = keep * jnp.array([[jnp.cos(swing * linear.interval), -jnp.sin(swing * linear.interval)],
                             [jnp.sin(swing * linear.interval), jnp.cos(swing * linear.interval)]])  # fmt: skip
    unmoved, still = jnp.zeros((2, count, experiments)), jnp.zeros((2, 2, experiments))
    onward = jnp.concatenate(
        [jnp.concatenate([unmoved, turn, still], axis=1), jnp.concatenate([unmoved, still, turn], axis=1)]
    )
    whole, variance = count + 4, linear.wander.white
    power = jnp.broadcast_to(jnp.stack([size[0], size[0], size[1], size[1]])[:, None] ** 2, (4, experiments))
    unit = jnp.eye(whole)[:, :, None]
    fresh = unit * jnp.concatenate([linear.wander.fresh, (1 - keep**2) * power])
    spread = unit * jnp.concatenate([linear.begin, power])

    def one(carry: Any, row: Any) -> Any:
        mean, spread = carry
        transition, push, shown, error, present, trusted, correction, lasts = row
        before = (mean, spread)
        likelihood = jnp.zeros(experiments)
        updates = []
        for j in range(len(variance)):
            h = jnp.concatenate([shown[j], jnp.zeros((4, experiments))])
            ph = jnp.sum(spread * h[None], axis=1)
            s = jnp.sum(h * ph, axis=0) + variance[j]
            off = error[j] - jnp.sum(h * mean, axis=0)
            k = present[j] * ph / s
            mean, spread = mean + k * off, spread - k[:, None] * ph[None]
            likelihood = likelihood - 0.5 * present[j] * (off**2 / s + jnp.log(s))
            updates.append(_Update(h, k, present[j] / s, off))
        moved = jnp.sum(correction * error[None], axis=1)
        nothing = jnp.zeros((count, experiments))
        pushes = jnp.stack([push[:, 0], nothing, push[:, 1], nothing], axis=1)
        forward = jnp.concatenate([jnp.concatenate([transition, pushes], axis=1), onward])
        known = mean.at[:count].add(-moved)
        after = jnp.sum(forward * known[None], axis=1)
        half = jnp.einsum("abe,bce->ace", forward, spread)
        grown = jnp.einsum("abe,cbe->ace", half, forward) + fresh
        onward_to = (after, 0.5 * (grown + jnp.swapaxes(grown, 0, 1)))
        carry = jax.tree.map(lambda new, held: jnp.where(lasts, new, held), onward_to, before)
        return carry, keep_of(_Filtered(mean, spread, forward, tuple(updates), lasts, trusted * likelihood))

    lasts = data.excitation.lasts(data.room)
    rows = (linear.transition, linear.push, linear.shown, linear.error, data.present, data.trusted, gain, lasts)
    start = jnp.zeros((whole, experiments))
    return time_loop(one, (start, spread), rows, room=data.room, samples=data.length)[1]


@program
def _likelihoods(linear: _Linear, data: Data, gain: Array, sizes: Array, correlation_time: Any, swing: Any) -> Array:
    return jax.lax.map(
        lambda size: _filter(linear, data, gain, size, correlation_time, swing, lambda row: row.likelihood).sum(),
        sizes, batch_size=max(1, _ABREAST // linear.error.shape[2]),
    )  # fmt: skip


@program
def _smoothed(
    linear: _Linear, data: Data, gain: Array, size: Array, correlation_time: Any, swing: Any
) -> tuple[Array, Array]:
    """Return mean and variance of the two forces, [sample port experiment].

    By the slope and the curvature of the likelihood of all later outputs (Bryson and Frazier), which inverts no covariance: a force
    that is all but nothing has one that is singular.
    """
    found = _filter(linear, data, gain, size, correlation_time, swing, lambda row: row)

    def one(later: tuple[Array, Array], row: _Filtered) -> Any:
        slope, curvature = (jnp.where(row.lasts, x, 0.0) for x in later)
        slope = jnp.sum(row.forward * slope[:, None], axis=0)
        curvature = jnp.einsum("bae,bce->ace", row.forward, jnp.einsum("bce,cde->bde", curvature, row.forward))
        mean = row.mean - jnp.sum(row.spread * slope[None], axis=1)
        half = jnp.einsum("abe,bce->ace", row.spread, curvature)
        variance = jnp.einsum("aae->ae", row.spread) - jnp.sum(half * row.spread, axis=1)
        for update in reversed(row.updates):
            slope = slope - update.shows * (update.weight * update.off + jnp.sum(update.gain * slope, axis=0))
            turned = jnp.sum(curvature * update.gain[None], axis=1)
            both = update.shows[:, None] * turned[None]
            own = update.weight + jnp.sum(update.gain * turned, axis=0)
            curvature = curvature - both - jnp.swapaxes(both, 0, 1)
            curvature = curvature + own * update.shows[:, None] * update.shows[None]
        return (slope, curvature), (mean[-4::2], variance[-4::2])

    nothing = jnp.zeros_like(found.mean[0]), jnp.zeros_like(found.spread[0])
    backwards = jax.tree.map(lambda x: x[::-1], found)
    mean, variance = time_loop(one, nothing, backwards, room=data.room, samples=data.room)[1]
    return mean[::-1], variance[::-1]
