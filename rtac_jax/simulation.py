"""The only time loop: Runge-Kutta steps and dry friction over all experiments at once, free or corrected by measurements."""

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rtac_jax._integration_step import beginning, integrated, needs_beginning, settle, slide, stop
from rtac_jax._numbers import Number, State
from rtac_jax._rtac import RTAC
from rtac_jax._sincos import sincos
from rtac_jax.equations import delivered, derivative, mobility, sensor_outputs
from rtac_jax.excitation import Excitation
from rtac_jax.programs import program
from rtac_jax.time_loop import time_loop

Steps = int | Int[Array, ""]
"""A number of steps; an array compiles once for all numbers."""

MOST_SUBSTEPS = 64
ANGLES = (0.0, 1.5)  # rad, of the arm, at which the fastest mode is looked for
_NEGLIGIBLE = 1e-100
_STAGES = ((0.0, 1.0), (0.5, 2.0), (0.5, 2.0), (1.0, 1.0))
"""Of a classic Runge-Kutta step: the fraction of it that has gone by, and six times the weight of the rates there."""
UNROLLED = 1 << 17
"""Samples from which `unrolls`."""


def unrolls(*sizes: int) -> bool:
    """Return whether the stages of a Runge-Kutta step are compiled one by one, for so many samples (a product of numbers).

    As a loop they compile in two thirds of the time. They run a third longer then, or a twentieth to a tenth where derivatives are
    carried along.
    """
    return math.prod(sizes) >= UNROLLED


def equations_of(model: RTAC) -> RTAC:
    """Return a model without what no equation reads, so that it compiles nothing: what is fixed, known, or of each experiment."""
    return RTAC(model.body, model.effects) if model.fixed or model.per_experiment or model.priors else model


def advance(
    model: RTAC,
    state: State,
    current: Sequence[Number] | None,
    force: Sequence[Number] | None,
    excitation: Excitation,
    *,
    substeps: Steps,
    unrolled: bool = False,
) -> State:
    """Return the state one sample later, by `substeps` classic Runge-Kutta steps, cut where dry friction brings to rest.

    Args:
        model: the rig.
        state: at the sample; one array for each state, SI units.
        current: polynomial coefficients of the current over the interval, rising powers of its fraction [A]; None for none.
        force: the same of the disturbance force [N].
        excitation: gives sample times and what is free to move.
        substeps: number of steps.
        unrolled: whether the stages of a step are compiled one by one; see `unrolls`.
    """
    step = excitation.sample_time / substeps

    def one(k: Array, at: State) -> State:
        begin = k / substeps
        return runge_kutta(
            model, at, current, force, excitation, step=step, begin=begin, substeps=substeps, unrolled=unrolled
        )

    # A loop whose length the compiler does not know: unrolled steps compile longer and run no faster, and where their
    # results are used many times they would be fused into, and computed anew for, each use.
    return jax.lax.fori_loop(0, jnp.asarray(substeps), one, state)


def runge_kutta(
    model: RTAC,
    state: State,
    current: Sequence[Number] | None,
    force: Sequence[Number] | None,
    excitation: Excitation,
    *,
    step: Number,
    begin: Number,
    substeps: Steps,
    unrolled: bool = False,
) -> State:
    """Take one of the `substeps` steps of an interval between samples.

    Args:
        model: whose equations act.
        state: at the beginning of the step.
        current: polynomial of the interval, as `advance` takes it.
        force: likewise.
        excitation: of which experiments.
        substeps: steps in an interval.
        step: its length [s].
        begin: fraction of the interval at which the step begins.
        unrolled: whether its stages are compiled one by one; see `unrolls`.
    """
    way = slide(model, state)
    began, at_first = None, _polynomial(current, begin)
    if needs_beginning(model):
        began = beginning(model, state, at_first, step, _polynomial(current, begin + 1.0 / substeps))
    places = integrated(model)

    def slope(at: State, elapsed: Number) -> State:
        """Return the rates of what is integrated, when this fraction of the step has gone by."""
        fraction = begin + elapsed / substeps
        rates = derivative(
            model,
            at,
            _polynomial(current, fraction),
            _polynomial(force, fraction),
            excitation.arm_free,
            excitation.cart_free,
            way,
            began and began._replace(elapsed=elapsed),
        )
        # An effect of one's own may return whole numbers, or others of single precision.
        return tuple(jnp.broadcast_to(jnp.asarray(rates[p], state[p].dtype), state[p].shape) for p in places)

    def along(rates: State, length: Number) -> State:
        """Return the state so long [s] after the beginning of the step, at these rates."""
        at = list(state)
        for place, rate in zip(places, rates, strict=True):
            at[place] = state[place] + length * rate
        return tuple(at)

    def stage(carry: tuple[State, State], row: tuple[Array, Array]) -> tuple[tuple[State, State], None]:
        (last, total), (elapsed, weight) = carry, row
        rates = slope(along(last, elapsed * step), elapsed)
        return (rates, tuple(x + weight * dx for x, dx in zip(total, rates, strict=True))), None

    if unrolled:
        rates_at = jax.jit(slope)
        k1 = rates_at(state, 0.0)
        k2 = rates_at(along(k1, 0.5 * step), 0.5)
        k3 = rates_at(along(k2, 0.5 * step), 0.5)
        k4 = rates_at(along(k3, step), 1.0)
        total = tuple(a + 2.0 * (b + c) + d for a, b, c, d in zip(k1, k2, k3, k4, strict=True))
    else:
        none = tuple(jnp.zeros_like(state[place]) for place in places)
        (_, total), _ = jax.lax.scan(stage, (none, none), tuple(jnp.array(_STAGES, state[0].dtype).T))
    end = began and began._replace(elapsed=1.0)
    smooth = along(total, step / 6.0)
    after = stop(model, state, smooth, at_first, step, excitation.arm_free, excitation.cart_free)
    return after if end is None else settle(model, after, end, excitation.arm_free, excitation.cart_free)


def _polynomial(coefficients: Sequence[Number] | None, fraction: Number) -> Any:
    if coefficients is None:
        return 0.0
    value = coefficients[-1]
    for lower in reversed(coefficients[:-1]):
        value = value * fraction + lower
    return value


@jax.custom_jvp
def without_denormals(x: Array) -> Array:
    """Set numbers too small to matter to zero: a processor works on denormal numbers a hundred times slower.

    States of a rig that comes to rest, and sensitivities to a start that a correction forgets, decay that far.
    """
    return jnp.where(jnp.abs(x) < _NEGLIGIBLE, 0.0, x)


@without_denormals.defjvp
def _without_denormals_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    return without_denormals(primals[0]), without_denormals(tangents[0])


def trajectories(
    model: RTAC,
    start: State,
    excitation: Excitation,
    *,
    samples: Steps,
    substeps: Steps,
    room: int | None = None,
    measured: tuple[Float[Array, "sample output experiment"], Float[Array, "sample output experiment"]] | None = None,
    gain: Float[Array, "sample state output experiment"] | None = None,
    states: bool = False,
    impulses: Float[Array, "sample 2 2 experiment"] | None = None,
    unrolled: bool | None = None,
) -> Float[Array, "sample row experiment"]:
    """Return the outputs of all experiments, one column each: cart position [m], arm velocity [rad/s], arm angle [rad].

    Of arrays that are longer than `samples` the first so many are run through; `room` is their length, and where it is given
    another number of samples compiles nothing. What is beyond is zero. An experiment that ends before holds its last state.
    With `measured` (values, and 1 where there is one) and `gain` the state is corrected by gain times the error at each
    sample before it moves on, and the outputs are predictions one sample ahead; without, they are a simulation.
    With `states` the rows are the states themselves instead of the outputs.
    With `impulses` a white random force on the cart [N s] and torque on the arm [N m s] act between the samples: the first
    number is the impulse, the second, independent and as large, makes the positions at the next sample what white noise
    makes them; an impulse at once would move them too far.
    Whether the stages of a step are `unrolled` is said by whoever may be batched by `jax.vmap`, of which nothing is seen here;
    else `unrolls` tells.
    """
    excitation = delivered(model, excitation)
    shape = excitation.sample_time.shape
    start = tuple(jnp.broadcast_to(x, shape) for x in start)
    room = room or int(samples)
    unrolled = unrolls(room, *shape) if unrolled is None else unrolled
    rows: dict[str, Any] = {"current": excitation.current, "force": excitation.force, "lasts": excitation.lasts(room)}
    if measured is not None and gain is not None:
        rows |= {"values": measured[0], "present": measured[1], "gain": gain}
    if impulses is not None:
        rows["impulses"] = impulses

    def one_sample(state: State, row: dict[str, Any]) -> tuple[State, Array]:
        before = state
        shown = jnp.stack([jnp.broadcast_to(y, shape) for y in (state if states else sensor_outputs(model, state))])
        if "gain" in row:
            read = jnp.stack([jnp.broadcast_to(y, shape) for y in sensor_outputs(model, state)]) if states else shown
            error = (row["values"] - read) * row["present"]
            shift: Any = sum(row["gain"][:, j] * error[j] for j in range(len(error)))
            state = tuple(x + dx for x, dx in zip(state, shift, strict=True))
        if "impulses" in row:
            on_cart, on_arm = unit_pushes(model, state, excitation)
            struck, other = (kick[0] * on_cart + kick[1] * on_arm for kick in row["impulses"])
            # Over the interval an impulse at its start moves by all of it; white noise by half and, at random, by 1 / sqrt 12.
            late = excitation.sample_time * (np.sqrt(1 / 12) * other - 0.5 * struck)
            state = tuple(x + struck[i] + (late[i + 1] if i in (0, 2) else 0.0) for i, x in enumerate(state))
        current, force = (None if row[name] is None else tuple(row[name]) for name in ("current", "force"))
        state = advance(model, state, current, force, excitation, substeps=substeps, unrolled=unrolled)
        state = tuple(jnp.where(row["lasts"], x, held) for x, held in zip(state, before, strict=True))
        return tuple(without_denormals(x) for x in state), shown

    return time_loop(one_sample, start, rows, room=room, samples=samples)[1]


def unit_pushes(
    model: RTAC, state: State, excitation: Excitation
) -> tuple[Float[Array, "state *shape"], Float[Array, "state *shape"]]:
    """Return the change of all states' rates by a unit force on the cart and by a unit torque on the arm."""
    cart_cart, cart_arm, arm_arm = mobility(model, sincos(state[2])[1], excitation.arm_free, excitation.cart_free)
    zero = jnp.zeros_like(state[0])
    rest = [zero] * (len(state) - 4)
    return jnp.stack([zero, cart_cart, zero, cart_arm, *rest]), jnp.stack([zero, cart_arm, zero, arm_arm, *rest])


def substeps_for(model: RTAC, excitation: Excitation, *, stability: float = 1.0, most: int = MOST_SUBSTEPS) -> int:
    """Return the Runge-Kutta steps per sample that keep the fastest mode of the model at rest well inside the stable region.

    Args:
        model: the rig; of parameters with several values the first is taken.
        excitation: gives the longest sample time.
        stability: step times fastest rate; classic Runge-Kutta is stable up to about 2.8.
        most: largest number of steps.
    """
    first = jax.tree.map(lambda leaf: np.ravel(leaf)[0], equations_of(model))
    fastest = float(np.max(np.abs(np.linalg.eigvals(np.asarray(rate_jacobians(first))))))
    return substeps_at(fastest, excitation, stability=stability, most=most)


def substeps_at(fastest: float, excitation: Excitation, *, stability: float = 1.0, most: int = MOST_SUBSTEPS) -> int:
    """Return what `substeps_for` does where the fastest rate [1/s] is known."""
    longest = float(np.max(np.asarray(excitation.sample_time)))
    return int(np.clip(np.ceil(longest * fastest / stability), 1, most))


@program
def rate_jacobians(model: RTAC) -> Float[Array, "angle state state"]:
    """Return the Jacobians of the state's rate at rest, at both angles of the arm."""

    def rate(x: Array) -> Array:
        # States that have a closed form are not integrated, however fast they are.
        since = beginning(model, tuple(x), jnp.zeros(()), 1.0, jnp.zeros(()))
        rates = derivative(model, tuple(x), jnp.zeros(()), 0.0, since=since)
        return jnp.stack([jnp.asarray(dx, dtype=float) for dx in rates])

    at = jnp.zeros((len(ANGLES), len(model.states))).at[:, 2].set(jnp.asarray(ANGLES))
    return jax.vmap(jax.jacfwd(rate))(at)
