"""The only time loop: Runge-Kutta steps and dry friction over all experiments at once, free or corrected by measurements."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rtac_jax._rtac import RTAC
from rtac_jax._since import Since
from rtac_jax.excitation import BEYOND, Excitation
from rtac_jax.measurement import Experiment
from rtac_jax.time_loop import room_for, time_loop

State = tuple[Any, ...]
Steps = int | Int[Array, ""]
"""A number of steps; an array compiles once for all numbers."""

_NEGLIGIBLE = 1e-100


def advance(
    model: RTAC,
    state: State,
    current: Sequence[Any] | None,
    force: Sequence[Any] | None,
    excitation: Excitation,
    *,
    substeps: Steps,
) -> State:
    """Return the state one sample later, by `substeps` classic Runge-Kutta steps, cut where dry friction brings to rest.

    Args:
        model: the rig.
        state: at the sample; one array for each state, SI units.
        current: polynomial coefficients of the current over the interval, rising powers of its fraction [A]; None for none.
        force: the same of the disturbance force [N].
        excitation: gives sample times and what is free to move.
        substeps: number of steps.
    """
    step = excitation.sample_time / substeps
    apart = model.steps_apart

    @jax.jit
    def slope(at: State, fraction: Any, way: Any, since: Since | None) -> State:
        return model.derivative(
            at,
            _polynomial(current, fraction),
            _polynomial(force, fraction),
            excitation.arm_free,
            excitation.cart_free,
            way,
            since,
        )

    def moved(at: State, by: Any, along: State) -> State:
        return tuple(x + by * dx for x, dx in zip(at, along, strict=True))

    def runge_kutta(at: State, begin: Any) -> State:
        way = model.slide(at)
        began = None
        if apart:
            began = model.since(at, _polynomial(current, begin), step, _polynomial(current, begin + 1.0 / substeps))
        middle, end = (began and began._replace(elapsed=share) for share in (0.5, 1.0))
        k1 = slope(at, begin, way, began)
        k2 = slope(moved(at, 0.5 * step, k1), begin + 0.5 / substeps, way, middle)
        k3 = slope(moved(at, 0.5 * step, k2), begin + 0.5 / substeps, way, middle)
        k4 = slope(moved(at, step, k3), begin + 1.0 / substeps, way, end)
        smooth = tuple(
            x + step / 6.0 * (a + 2.0 * (b + c) + d) for x, a, b, c, d in zip(at, k1, k2, k3, k4, strict=True)
        )
        after = model.stop(at, smooth, step, excitation.arm_free, excitation.cart_free)
        return after if end is None else model.settle(after, end, excitation.arm_free, excitation.cart_free)

    # A loop whose length the compiler does not know: unrolled steps compile longer and run no faster, and where their
    # results are used many times they would be fused into, and computed anew for, each use.
    return jax.lax.fori_loop(0, jnp.asarray(substeps), lambda k, at: runge_kutta(at, k / substeps), state)


def _polynomial(coefficients: Sequence[Any] | None, fraction: Any) -> Any:
    if coefficients is None:
        return 0.0
    value = coefficients[-1]
    for lower in reversed(coefficients[:-1]):
        value = value * fraction + lower
    return value


@jax.custom_jvp
def _without_denormals(x: Array) -> Array:
    """Set numbers too small to matter to zero: a processor works on denormal numbers a hundred times slower.

    States of a rig that comes to rest, and sensitivities to a start that a correction forgets, decay that far.
    """
    return jnp.where(jnp.abs(x) < _NEGLIGIBLE, 0.0, x)


@_without_denormals.defjvp
def _without_denormals_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    return _without_denormals(primals[0]), _without_denormals(tangents[0])


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
) -> Float[Array, "sample row experiment"]:
    """Return the outputs of all experiments, one column each: cart position [m], arm velocity [rad/s], arm angle [rad].

    Of arrays that are longer than `samples` the first so many are run through; `room` is their length, and where it is given
    another number of samples compiles nothing. What is beyond is zero.
    With `measured` (values, and 1 where there is one) and `gain` the state is corrected by gain times the error at each
    sample before it moves on, and the outputs are predictions one sample ahead; without, they are a simulation.
    With `states` the rows are the states themselves instead of the outputs.
    With `impulses` a white random force on the cart [N s] and torque on the arm [N m s] act between the samples: the first
    number is the impulse, the second, independent and as large, makes the positions at the next sample what white noise
    makes them; an impulse at once would move them too far.
    """
    excitation = model.driven(excitation)
    shape = excitation.sample_time.shape
    start = tuple(jnp.broadcast_to(x, shape) for x in start)
    rows: dict[str, Any] = {"current": excitation.current, "force": excitation.force}
    if measured is not None and gain is not None:
        rows |= {"values": measured[0], "present": measured[1], "gain": gain}
    if impulses is not None:
        rows["impulses"] = impulses

    def one_sample(state: State, row: dict[str, Any]) -> tuple[State, Array]:
        shown = jnp.stack([jnp.broadcast_to(y, shape) for y in (state if states else model.outputs(state))])
        if "gain" in row:
            outputs = jnp.stack([jnp.broadcast_to(y, shape) for y in model.outputs(state)]) if states else shown
            error = (row["values"] - outputs) * row["present"]
            state = tuple(x + sum(row["gain"][i, j] * error[j] for j in range(len(error))) for i, x in enumerate(state))
        if "impulses" in row:
            on_cart, on_arm = unit_pushes(model, state, excitation)
            struck, other = (kick[0] * on_cart + kick[1] * on_arm for kick in row["impulses"])
            # Over the interval an impulse at its start moves by all of it; white noise by half and, at random, by 1 / sqrt 12.
            late = excitation.sample_time * (np.sqrt(1 / 12) * other - 0.5 * struck)
            state = tuple(x + struck[i] + (late[i + 1] if i in (0, 2) else 0.0) for i, x in enumerate(state))
        current, force = (None if row[name] is None else tuple(row[name]) for name in ("current", "force"))
        state = advance(model, state, current, force, excitation, substeps=substeps)
        return tuple(_without_denormals(x) for x in state), shown

    return time_loop(one_sample, start, rows, room=room or int(samples), samples=samples)[1]


def unit_pushes(
    model: RTAC, state: State, excitation: Excitation
) -> tuple[Float[Array, "state experiment"], Float[Array, "state experiment"]]:
    """Return the change of all states' rates by a unit force on the cart and by a unit torque on the arm."""
    cart_cart, cart_arm, arm_arm = model.pushes(state, excitation.arm_free, excitation.cart_free)
    zero = jnp.zeros_like(state[0])
    rest = [zero] * (len(state) - 4)
    return jnp.stack([zero, cart_cart, zero, cart_arm, *rest]), jnp.stack([zero, cart_arm, zero, arm_arm, *rest])


def substeps_for(model: RTAC, excitation: Excitation, *, stability: float = 1.0, most: int = 64) -> int:
    """Return the Runge-Kutta steps per sample that keep the fastest mode of the model at rest well inside the stable region.

    Args:
        model: the rig; of parameters with several values the first is taken.
        excitation: gives the longest sample time.
        stability: step times fastest rate; classic Runge-Kutta is stable up to about 2.8.
        most: largest number of steps.
    """
    count = len(model.states)
    longest = float(np.max(np.asarray(excitation.sample_time)))
    first = jax.tree.map(lambda leaf: jnp.asarray(np.ravel(leaf)[0]), model)
    fastest = 0.0
    for angle in (0.0, 1.5):
        at = np.zeros(count)
        at[2] = angle
        fastest = max(fastest, float(np.max(np.abs(np.linalg.eigvals(np.asarray(_slopes(first, jnp.asarray(at))))))))
    return int(np.clip(np.ceil(longest * fastest / stability), 1, most))


@eqx.filter_jit
def _slopes(model: RTAC, at: Array) -> Array:
    """Return the Jacobian of the state's rate."""

    def rate(x: Array) -> Array:
        # States that have a closed form are not integrated, however fast they are.
        since = model.since(tuple(x), jnp.zeros(()), 1.0, jnp.zeros(()))
        rates = model.derivative(tuple(x), jnp.zeros(()), 0.0, since=since)
        return jnp.stack([jnp.asarray(dx, dtype=float) for dx in rates])

    return jax.jacfwd(rate)(at)


@dataclasses.dataclass(frozen=True)
class Simulation:
    """The simulation of an experiment; arrays of one length.

    Attributes:
        time: [s].
        cart_position, arm_velocity, arm_angle: as the sensors show them [m, rad/s, rad].
        states: every state of the model by name, SI units.
    """

    time: Float[np.ndarray, " sample"]
    cart_position: Float[np.ndarray, " sample"]
    arm_velocity: Float[np.ndarray, " sample"]
    arm_angle: Float[np.ndarray, " sample"]
    states: Mapping[str, Float[np.ndarray, " sample"]]

    def __repr__(self) -> str:
        return f"Simulation({len(self.time)} samples, {self.time[-1]:.6g} s, states {', '.join(self.states)})"


def simulate(
    model: RTAC,
    experiments: Iterable[Experiment],
    *,
    start: Mapping[str, Sequence[float | int] | np.ndarray | Array] | None = None,
    substeps: int | None = None,
) -> dict[str, Simulation]:
    """Simulate experiments of any lengths, sample times and inputs in one call.

    Args:
        model: the rig.
        experiments: a recording, or some of its experiments; their inputs, holds and lengths are taken, their outputs not.
        start: cart position [m], cart velocity [m/s], arm angle [rad] and arm velocity [rad/s] at the start, by name of
            experiment; what is not named starts at rest in the origin at its `initial_arm_angle`. More than four numbers
            give every state of the model.
        substeps: Runge-Kutta steps per sample; by default as the fastest mode asks.

    Returns:
        By name of experiment.

    Raises:
        ValueError: no experiment, or a start of the wrong length.
    """
    chosen = list(experiments)
    if not chosen:
        raise ValueError("simulate needs at least one experiment.")
    samples = max(e.samples for e in chosen)
    room = room_for(samples + BEYOND)
    excitation = Excitation.of(chosen, room=room)
    rigid = np.zeros((4, len(chosen)))
    whole: dict[int, np.ndarray] = {}
    for column, experiment in enumerate(chosen):
        rigid[2, column] = experiment.initial_arm_angle or 0.0
        given = None if start is None else start.get(experiment.name)
        if given is not None:
            values = np.asarray(given, dtype=float)
            if values.shape not in {(4,), (len(model.states),)}:
                raise ValueError(
                    f"start of experiment {experiment.name} has shape {values.shape}; give 4 or {len(model.states)} numbers."
                )
            rigid[:, column] = values[:4]
            if len(values) > 4:
                whole[column] = values
    state = model.start(tuple(jnp.asarray(rigid)), excitation.first_current())
    table = np.stack([np.broadcast_to(np.asarray(x), (len(chosen),)) for x in state]).copy()
    for column, values in whole.items():
        table[:, column] = values
    steps = substeps if substeps is not None else substeps_for(model, excitation, stability=0.5)
    found = np.asarray(_states(model, jnp.asarray(table), excitation, room, jnp.asarray(samples), jnp.asarray(steps)))
    shown = [np.broadcast_to(np.asarray(y), found[:, 0].shape) for y in model.outputs(tuple(np.moveaxis(found, 1, 0)))]
    result = {}
    for column, e in enumerate(chosen):
        part = slice(0, e.samples)
        position, velocity, angle = (np.array(y[part, column]) for y in shown)
        states = {name: np.array(found[part, row, column]) for row, name in enumerate(model.states)}
        result[e.name] = Simulation(np.asarray(e.time), position, velocity, angle, states)
    return result


@eqx.filter_jit
def _states(model: RTAC, start: Array, excitation: Excitation, room: int, samples: Steps, substeps: Steps) -> Array:
    return trajectories(model, tuple(start), excitation, room=room, samples=samples, substeps=substeps, states=True)
