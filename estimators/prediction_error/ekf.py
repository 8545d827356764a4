"""Gains of an extended Kalman filter along all experiments at once, for a model with random force and torque."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from estimators.core.data import CHANNELS, Data
from estimators.core.parameter_space import Physical, Space
from estimators.core.residual import states_at_start
from estimators.prediction_error.coloured_noise import ColourStates
from rtac_jax import RTAC
from rtac_jax.equations import delivered, friction_levels, sensor_outputs
from rtac_jax.programs import program
from rtac_jax.simulation import State, Steps, advance, unit_pushes, unrolls
from rtac_jax.time_loop import time_loop

OUTPUTS = len(CHANNELS)
_VELOCITIES = (1, 3)  # places of the velocities of cart and arm in the state
# Fraction of their motion in a sample by which parts may be farther on or behind. Where they hit each other near the end of a
# sample, an error of a tenth of a sample decides which of two samples shows it, and that one would count for a hundred others.
_EARLY = 0.5
_SURE = 1e-6  # deviation of such states below which dividing by it would magnify rounding
_SMALL = 1e-9  # velocities [m/s, rad/s] below which a difference is lost in rounding


class Filtered(NamedTuple):
    """The result of a pass of the filter.

    Attributes:
        gain: correction of the state by the prediction error at each sample.
        whitener: lower triangular; times the prediction error it is white with unit variance. Zero where samples are not
            trusted, and so are the innovations and their part of the likelihood.
        innovations: prediction errors in units of their standard deviation.
        log_likelihood: of each experiment, less the constant.
        shaken: 1 at the sample after one that is stick-slip ambiguous, where random forces may overcome dry friction and neither
            the model's rest nor its motion is to be believed; else 0.
    """

    gain: Float[Array, "sample state output experiment"]
    whitener: Float[Array, "sample output output experiment"]
    innovations: Float[Array, "sample output experiment"]
    log_likelihood: Float[Array, " experiment"]
    shaken: Float[Array, "sample experiment"]


class Linearised(NamedTuple):
    """The linear model along a pass of the filter, of which the derivatives of its likelihood by the noise are made.

    Attributes:
        shown: derivatives of the outputs by the state; zero where nothing is measured.
        transition: derivatives of the next state by this one.
        pushes: standard deviations of the state from half of what a random force and a random torque do in an interval.
        weighed: prediction errors times the inverse of their covariance, trusted or not.
        variance: of what is white of each output's noise.
        stationary: variance of the states at the start that is in proportion to each noise.
        fresh: of that, what every sample brings anew.
    """

    shown: Float[Array, "sample output state experiment"]
    transition: Float[Array, "sample state state experiment"]
    pushes: Float[Array, "sample process state experiment"]
    weighed: Float[Array, "sample output experiment"]
    variance: Float[Array, "output experiment"]
    stationary: Float[Array, "noise state experiment"]
    fresh: Float[Array, "noise state experiment"]


def kalman(
    model: RTAC,
    data: Data,
    space: Space,
    physical: Physical,
    *,
    sensor_variance: Float[Array, "output experiment"],
    process: tuple[float | Float[Array, ""], float | Float[Array, ""]],
    start_variance: Float[Array, "start experiment"],
    substeps: Steps,
) -> tuple[Filtered, Linearised]:
    """Run the extended Kalman filter along all experiments.

    Args:
        model: with random force and torque beside its own forces.
        data: of all experiments.
        space: of the model's parameters and starts.
        physical: shared parameters, those of each experiment, and states at the start, SI units.
        sensor_variance: of each output's noise, SI units squared.
        process: spectral densities of a random force on the cart [N^2 s] and of a random torque on the arm [(N m)^2 s].
        start_variance: of the states at the start.
        substeps: of the integrator in each sample.

    Source: Jazwinski, Stochastic Processes and Filtering Theory (1970), chapter 8.
    """
    shared, each, start = physical
    placed = model.with_values(dict(zip(space.names, shared, strict=True)) | dict(zip(space.each, each, strict=True)))
    excitation = delivered(placed, data.excitation)
    shape = excitation.sample_time.shape
    unrolled = unrolls(data.room, *shape)
    state = tuple(jnp.broadcast_to(x, shape) for x in states_at_start(placed, start, excitation))
    count = len(state)
    places = start_places(model)
    spread = jnp.zeros((count, count, *shape))
    if len(start_variance) != len(places):
        raise ValueError(f"{len(start_variance)} variances for {len(places)} states at the start.")
    for row, place in enumerate(places):
        spread = spread.at[place, place].set(start_variance[row])
    wander = wandering(placed, sensor_variance, excitation.sample_time)
    sensor_variance = wander.white
    spread = spread + jnp.eye(count)[:, :, None] * wander.stationary[:, None]
    unit = tuple(jnp.broadcast_to(row[:, None], (count, *shape)) for row in jnp.eye(count))
    rubs = bool(friction_levels(placed, state))
    strikes = impact_places(model)
    wide = (*(_VELOCITIES if rubs else ()), *strikes)

    def one_sample(carry: tuple[State, Array], row: dict[str, Any]) -> tuple[tuple[State, Array], Any]:
        state, spread = carry

        def shown(at: State) -> State:
            return tuple(jnp.broadcast_to(y, shape) for y in sensor_outputs(placed, at))

        outputs, seen = _with_slopes(shown, state, unit)
        error = (row["values"] - outputs) * row["present"]
        whitener, innovations = [], []
        likelihood = jnp.zeros(shape)
        # Outputs are uncorrelated given the state, so they are taken one after the other; the rows of the triangular
        # whitener and the joint gain follow by substitution.
        gain = jnp.zeros((count, OUTPUTS, *shape))
        for j in range(OUTPUTS):
            there, h = row["present"][j], seen[j]
            ph = jnp.sum(spread * h[None], axis=1)
            variance = jnp.sum(h * ph, axis=0) + sensor_variance[j]
            deviation = jnp.sqrt(variance)
            # innovation_j = e_j - h . gain e, linear in the errors e_0 .. e_j
            weights = (jnp.eye(OUTPUTS)[j][:, None] - jnp.sum(h[:, None] * gain, axis=0)) * row["present"]
            innovation = there * jnp.sum(weights * error, axis=0)
            innovations.append(innovation / deviation)
            whitener.append(there * weights / deviation)
            likelihood = likelihood - 0.5 * there * (innovation**2 / variance + jnp.log(variance))
            k = there * ph / variance
            gain = gain + k[:, None] * weights[None]
            spread = spread - k[:, None] * ph[None, :]
        spread = 0.5 * (spread + jnp.swapaxes(spread, 0, 1))
        shift = jnp.sum(gain * error[None], axis=1)
        state = tuple(x + dx for x, dx in zip(state, shift, strict=True))

        current, force = (None if row[name] is None else tuple(row[name]) for name in ("current", "force"))

        def forward(at: State) -> State:
            return advance(placed, at, current, force, excitation, substeps=substeps, unrolled=unrolled)

        pushes = unit_pushes(placed, state, excitation)
        moved, jacobian = _linearised(forward, state, spread, wide)
        shaken = jnp.zeros(shape)
        if rubs:
            driven = 0.0 if current is None else current[0]
            shaken = _shaken(placed, state, driven, spread, process, pushes, excitation.sample_time)
        # Half of what strikes in the interval at its start, half at its end.
        halves = jnp.stack(
            [jnp.sqrt(0.5 * excitation.sample_time * d) * p for d, p in zip(process, pushes, strict=True)]
        )
        later = jnp.sum(jacobian[None] * halves[:, None], axis=2)
        pushed = halves[:, :, None] * halves[:, None] + later[:, :, None] * later[:, None]
        spread = _product(_product(jacobian, spread), jnp.swapaxes(jacobian, 0, 1)) + pushed[0] + pushed[1]
        spread = spread + jnp.eye(count)[:, :, None] * wander.fresh[:, None]
        for place in strikes:
            spread = spread.at[place, place].add((_EARLY * (moved[place] - state[place])) ** 2)
        carry = jax.tree.map(lambda new, held: jnp.where(row["lasts"], new, held), (tuple(moved), spread), carry)
        linear = seen * row["present"][:, None], jacobian, halves
        return carry, ((gain, jnp.stack(whitener), jnp.stack(innovations), likelihood, shaken), linear)

    rows = {
        "current": excitation.current, "force": excitation.force, "values": data.values, "present": data.present,
        "lasts": excitation.lasts(data.room),
    }  # fmt: skip
    _, (found, linear) = time_loop(one_sample, (state, spread), rows, room=data.room, samples=data.length)
    gain, whitener, innovations, likelihood, shaken = found
    # Not the sample itself: to leave out samples for what they show would bias what is left.
    after = jnp.concatenate([jnp.zeros_like(shaken[:1]), shaken[:-1]]) * rows["lasts"]
    weighed, counts = jnp.sum(whitener * innovations[:, :, None], axis=1), data.trusted[:, None]
    filtered = Filtered(
        gain, counts[:, None] * whitener, counts * innovations, jnp.sum(data.trusted * likelihood, axis=0), after
    )
    stationary, fresh = map(wander.by_noise, (wander.stationary, wander.fresh))
    shown, transition, pushes = linear
    return filtered, Linearised(shown, transition, pushes, weighed, wander.white, stationary, fresh)


@program
def filtered(*arguments: Any, **known: Any) -> Filtered:
    """Run the filter alone, compiled; see `kalman`."""
    return kalman(*arguments, **known)[0]


class Wander(NamedTuple):
    """The sensor noise of a model, white and coloured.

    Attributes:
        white: variance of what is white.
        stationary: variance of the states that carry what is coloured; zero for all others.
        fresh: of that, what every sample brings anew.
        places: of these states, one for each sensor.
    """

    white: Float[Array, "output experiment"]
    stationary: Float[Array, "state experiment"]
    fresh: Float[Array, "state experiment"]
    places: tuple[int, ...]

    def by_noise(self, own: Float[Array, "state experiment"]) -> Float[Array, "noise state experiment"]:
        """Return the part of the states' own variance that is in proportion to each noise: to none but that of their sensor."""
        found = jnp.zeros((2 + len(CHANNELS), *own.shape))
        for sensor, place in enumerate(self.places):
            found = found.at[2 + sensor, place].set(own[place])
        return found


def wandering(
    model: RTAC, variance: Float[Array, "output experiment"], sample_time: Float[Array, " experiment"]
) -> Wander:
    """Split the variance of the sensor noise as the model's `ColourStates` say; all white without it."""
    names = list(model.states)
    nothing = jnp.zeros((len(names), len(sample_time)))
    colour = next((effect for effect in model.effects if isinstance(effect, ColourStates)), None)
    if colour is None:
        return Wander(variance, nothing, nothing, ())
    fraction, keep = colour.fraction[:, None], jnp.exp(-sample_time / colour.correlation_time[:, None])
    places = tuple(names.index(f"{colour.id}.{channel}") for channel in CHANNELS)
    at, slow = jnp.asarray(places), fraction * variance
    return Wander(variance - slow, nothing.at[at].set(slow), nothing.at[at].set((1 - keep**2) * slow), places)


def start_places(model: RTAC) -> tuple[int, ...]:
    """Return the places of the states whose initial value an experiment may leave open."""
    places, place = [0, 1, 2, 3], 4
    for effect in model.effects:
        for _ in effect.states:
            if effect.free_start:
                places.append(place)
            place += 1
    return tuple(places)


def impact_places(model: RTAC) -> tuple[int, ...]:
    """Return the places of the states that tell how far parts that hit each other are apart: those of length or angle."""
    owners = [(effect, unit) for effect in model.effects for unit in effect.states.values()]
    return tuple(
        4 + row for row, (effect, unit) in enumerate(owners) if effect.acts_by_contact and unit in ("m", "rad")
    )


def _with_slopes(function: Callable[[State], State], state: State, unit: State) -> tuple[Array, Array]:
    """Return the value [row experiment], and its derivatives by every state [row state experiment]."""
    value, slopes = jax.vmap(lambda t: jax.jvp(function, (state,), (t,)), out_axes=(None, 0))(unit)
    return jnp.stack(value), jnp.stack(slopes)


def _shaken(
    model: RTAC,
    state: State,
    current: Array | float,
    spread: Array,
    process: tuple[float | Float[Array, ""], float | Float[Array, ""]],
    pushes: tuple[Array, Array],
    interval: Array,
) -> Float[Array, " experiment"]:
    """Return 1 where an experiment is stick-slip ambiguous, else 0.

    The cart or the arm may rest there, and three standard deviations of the random force exceed its dry friction.
    """
    levels = friction_levels(model, state, current)
    found = jnp.zeros_like(state[0])
    for body, place in enumerate(_VELOCITIES):
        level = sum((pair[body] for pair in levels), start=0.0)
        push = pushes[body][place]
        kicked = process[body] * interval * push**2  # variance of the velocity after one sample
        strong = (9 * kicked > (interval * level * push) ** 2) & (level > 0)
        slow = state[place] ** 2 < 9 * (spread[place, place] + kicked)
        found = jnp.where(strong & slow, 1.0, found)
    return found


def _linearised(
    function: Callable[[State], State],
    state: State,
    spread: Float[Array, "state state experiment"],
    wide: tuple[int, ...],
) -> tuple[Float[Array, "row experiment"], Float[Array, "row state experiment"]]:
    """Return the next state and its derivatives, those by some states over one standard deviation to either side.

    Where dry friction holds a body at rest the derivative by its velocity is zero, and a filter that believes it would
    never doubt again that the body rests, while random forces shake it loose. The same holds for parts that are about
    to hit each other: a filter that believes the derivative never doubts whether they have by the next sample.

    Where a state is known better than rounding lets differences be, they are over the least that it does.

    Every derivative has its own copy of the state: arrays of one shape become few loops, and these cost more than their
    work.

    Args:
        function: from one state to the next.
        state: the present one.
        spread: covariance of the state.
        wide: places of these states.

    Source: statistical linearisation; Gelb, Applied Optimal Estimation (1974), section 6.2.
    """
    at = jnp.stack(state)
    count = len(state)
    narrow = [place for place in range(count) if place not in wide]
    points, unit = [at] * len(narrow), jnp.eye(count)
    along = [jnp.broadcast_to(unit[place][:, None], at.shape) for place in narrow]
    least = {place: _SMALL if place in _VELOCITIES else _SURE for place in wide}
    reaches = [jnp.maximum(jnp.sqrt(jnp.maximum(spread[place, place], 0.0)), least[place]) for place in wide]
    points += [at.at[place].add(sign * r) for place, r in zip(wide, reaches, strict=True) for sign in (1.0, -1.0)]
    along += [jnp.zeros_like(at)] * (len(points) - len(narrow))

    def one(point: Array, direction: Array) -> tuple[Array, Array]:
        return jax.jvp(lambda x: jnp.stack(function(tuple(x))), (point,), (direction,))

    ends, slopes = jax.vmap(one)(jnp.stack(points), jnp.stack(along))
    columns = dict(zip(narrow, slopes[: len(narrow)], strict=True))
    beside = ends[len(narrow) :]
    for place, r, ahead, behind in zip(wide, reaches, beside[::2], beside[1::2], strict=True):
        columns[place] = (ahead - behind) / (2 * r)
    # Not set within an array that is read beside it: the compiled code then mixed the two.
    return ends[0], jnp.stack([columns[place] for place in range(count)], axis=1)


def _product(a: Array, b: Array) -> Array:
    return jnp.sum(a[:, :, None] * b[None, :, :], axis=1)
