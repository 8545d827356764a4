"""The only time loop: classic Runge-Kutta steps over all experiments at once, with or without a correction by measurements."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rtac_jax._excitation import Excitation
from rtac_jax._rtac import RTAC

State = tuple[Any, ...]

_NEGLIGIBLE = 1e-100


def advance(
    model: RTAC,
    state: State,
    current: Sequence[Any] | None,
    force: Sequence[Any] | None,
    excitation: Excitation,
    *,
    substeps: int,
) -> State:
    """The state one sample later, by `substeps` classic Runge-Kutta steps.

    Args:
        current, force: polynomial coefficients of the inputs over the interval, rising powers of its fraction.
    """
    step = excitation.sample_time / substeps

    def slope(at: State, fraction: float) -> State:
        return model.derivative(
            at,
            _polynomial(current, fraction),
            _polynomial(force, fraction),
            excitation.arm_free,
            excitation.cart_free,
        )

    def moved(at: State, by: Any, along: State) -> State:
        return tuple(x + by * dx for x, dx in zip(at, along, strict=True))

    for k in range(substeps):
        begin, middle, end = k / substeps, (k + 0.5) / substeps, (k + 1) / substeps
        k1 = slope(state, begin)
        k2 = slope(moved(state, 0.5 * step, k1), middle)
        k3 = slope(moved(state, 0.5 * step, k2), middle)
        k4 = slope(moved(state, step, k3), end)
        state = tuple(
            x + step / 6.0 * (a + 2.0 * (b + c) + d) for x, a, b, c, d in zip(state, k1, k2, k3, k4, strict=True)
        )
    return state


def _polynomial(coefficients: Sequence[Any] | None, fraction: float) -> Any:
    if coefficients is None:
        return 0.0
    value = coefficients[-1]
    for lower in reversed(coefficients[:-1]):
        value = value * fraction + lower
    return value


@jax.custom_jvp
def _without_denormals(x: Array) -> Array:
    """x, with numbers too small to matter set to zero: a processor works on denormal numbers a hundred times slower.

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
    samples: int,
    substeps: int,
    measured: tuple[Float[Array, "sample output experiment"], Float[Array, "sample output experiment"]] | None = None,
    gain: Float[Array, "sample state output experiment"] | None = None,
) -> Float[Array, "sample output experiment"]:
    """Outputs of all experiments, one column each: cart position [m], arm velocity [rad/s], arm angle [rad].

    With `measured` (values, and 1 where there is one) and `gain` the state is corrected by gain times the error at each
    sample before it moves on, and the outputs are predictions one sample ahead; without, they are a simulation.
    """
    shape = excitation.sample_time.shape
    start = tuple(jnp.broadcast_to(x, shape) for x in start)
    rows: dict[str, Any] = {"current": excitation.current, "force": excitation.force}
    if measured is not None and gain is not None:
        rows |= {"values": measured[0], "present": measured[1], "gain": gain}

    def one_sample(state: State, row: dict[str, Any]) -> tuple[State, Array]:
        shown = jnp.stack([jnp.broadcast_to(y, shape) for y in model.outputs(state)])
        if "gain" in row:
            error = (row["values"] - shown) * row["present"]
            state = tuple(
                x + sum(row["gain"][i, j] * error[j] for j in range(len(error))) for i, x in enumerate(state)
            )
        inputs = (None if row[name] is None else tuple(row[name]) for name in ("current", "force"))
        state = advance(model, state, *inputs, excitation, substeps=substeps)
        return tuple(_without_denormals(x) for x in state), shown

    return jax.lax.scan(one_sample, start, rows, length=samples)[1]


def substeps_for(model: RTAC, excitation: Excitation, *, stability: float = 1.0, most: int = 64) -> int:
    """Runge-Kutta steps per sample that keep the fastest mode of the model at rest well inside the stable region.

    The fastest mode is that of the linearised model at standstill, where smoothed friction is stiffest.

    Args:
        stability: step times fastest rate; classic Runge-Kutta is stable up to about 2.8.
    """
    count = len(model.states)
    longest = float(np.max(np.asarray(excitation.sample_time)))
    first = jax.tree.map(lambda leaf: jnp.ravel(jnp.asarray(leaf))[0], model)

    def slope(x: Array) -> Array:
        return jnp.stack([jnp.asarray(dx, dtype=float) for dx in first.derivative(tuple(x), jnp.zeros(()), 0.0)])

    fastest = 0.0
    for angle in (0.0, 1.5):
        at = jnp.zeros(count).at[2].set(angle)
        fastest = max(fastest, float(np.max(np.abs(np.linalg.eigvals(np.asarray(jax.jacfwd(slope)(at)))))))
    return int(np.clip(np.ceil(longest * fastest / stability), 1, most))
