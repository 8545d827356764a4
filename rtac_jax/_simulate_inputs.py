"""Simulate inputs that are given as arrays: no recording, no outputs."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rtac_jax._numbers import Number
from rtac_jax._rtac import RTAC
from rtac_jax._run import run, whole_starts
from rtac_jax._simulation_record import Simulation, simulation_of
from rtac_jax._spline import FEWEST, spline_coefficients
from rtac_jax.arguments import checked_arguments
from rtac_jax.configuration import warn_single_precision
from rtac_jax.effect_contract import require_working_model
from rtac_jax.equations import sensor_outputs
from rtac_jax.excitation import BEYOND, Excitation
from rtac_jax.programs.arrays import is_traced
from rtac_jax.time_loop import room_for

Input = Sequence[Any] | np.ndarray | Array


@checked_arguments
def simulate_inputs(
    model: RTAC,
    *,
    sample_time: Number,
    current: Input | None = None,
    disturbance_force: Input | None = None,
    samples: int | None = None,
    start: Input = (0.0, 0.0, 0.0, 0.0),
    intersample: str = "zoh",
    arm: str = "free",
    cart: str = "free",
    substeps: int | None = None,
) -> Simulation:
    """Simulate the response to inputs.

    It may be traced: `jax.jit`, `jax.vmap`, `jax.jacfwd` and `jax.grad` work by the model's values, the inputs, the start and
    the sample time. A batch over parameter sets or inputs is one call:

        def position(values, current):
            model_there = model.with_values(values)
            return rtac.simulate_inputs(model_there, current=current, sample_time=0.005).cart_position

        sets = {"spring_stiffness": jnp.linspace(120.0, 140.0, 64)}
        positions = jax.jit(jax.vmap(position, (0, None)))(sets, current)  # [64 sample]

    Args:
        model: at the values to simulate with.
        sample_time: [s].
        current: of the motor [A], one number per sample; None where it is idle.
        disturbance_force: on the cart [N], likewise.
        samples: how many, where there is no input; else they have as many.
        start: cart position [m], cart velocity [m/s], arm angle [rad] and arm velocity [rad/s] at the first sample, or every
            state of the model.
        intersample: how the inputs run between samples: "zoh" held, "foh" straight lines, "bl" band-limited, a cubic spline.
        arm: "free" or "locked".
        cart: "free" or "clamped".
        substeps: Runge-Kutta steps per sample; by default as the fastest mode asks, in a batch the fastest of all.

    Raises:
        ValueError: inputs of several lengths, not finite or of more than one dimension, no length at all, a sample time
            that is not positive, an unknown word, a start of the wrong length, or a user's own effect that does not work.
    """
    warn_single_precision()
    require_working_model(model)
    for name, word, known in (
        ("intersample", intersample, ("zoh", "foh", "bl")),
        ("arm", arm, ("free", "locked")),
        ("cart", cart, ("free", "clamped")),
    ):
        if word not in known:
            raise ValueError(f"{name} is {word!r}; use one of {', '.join(known)}.")
    if not is_traced(sample_time) and not (np.ndim(sample_time) == 0 and 0 < float(sample_time) < np.inf):
        raise ValueError(f"sample_time [s] is {sample_time}; it must be a positive number.")
    given = {"current": current, "disturbance_force": disturbance_force}
    signals = {name: _signal(name, values, intersample) for name, values in given.items() if values is not None}
    lengths = {name: len(values) for name, values in signals.items()}
    if samples is not None:
        lengths["samples"] = samples
    if not lengths:
        raise ValueError("samples is not given; without an input it says how long to simulate.")
    if len(set(lengths.values())) > 1:
        raise ValueError(f"the lengths differ: {', '.join(f'{name} {count}' for name, count in lengths.items())}.")
    count = next(iter(lengths.values()))
    if count < 1:
        raise ValueError("there is no sample; give at least one.")
    room = room_for(count + BEYOND)
    pieces = {name: _pieces(values, intersample, room) for name, values in signals.items()}
    excitation = Excitation(
        current=pieces.get("current"),
        force=pieces.get("disturbance_force"),
        sample_time=jnp.asarray(sample_time, dtype=float)[None],
        arm_free=jnp.asarray([float(arm == "free")]),
        cart_free=jnp.asarray([float(cart == "free")]),
    )
    table = whole_starts(model, [start], ["the simulation"], excitation)
    states = run(model, table, excitation, room=room, samples=count, substeps=substeps)
    outputs = sensor_outputs(model, tuple(states[:, row] for row in range(states.shape[1])))
    times = np.arange(count) * (sample_time if is_traced(sample_time) else float(sample_time))
    return simulation_of(model, states, outputs, 0, times)


def _signal(name: str, values: Input, intersample: str) -> Array | np.ndarray:
    signal = (jnp if is_traced(values) else np).asarray(values, dtype=float)
    if signal.ndim != 1:
        raise ValueError(f"{name} has shape {signal.shape}; give one number per sample, and a batch by jax.vmap.")
    if isinstance(signal, np.ndarray) and not np.all(np.isfinite(signal)):
        raise ValueError(f"{name}, sample {int(np.argmin(np.isfinite(signal)))}: is not a finite number.")
    if intersample == "bl" and len(signal) < FEWEST:
        raise ValueError(f"{name} has {len(signal)} samples; a band-limited input needs at least {FEWEST}.")
    return signal


def _pieces(signal: Array | np.ndarray, intersample: str, room: int) -> Float[Array, "sample power 1"]:
    """Return the input's polynomials; beyond its end it goes on as in `Excitation.of`."""
    values = jnp.asarray(signal, dtype=float)
    if intersample == "zoh":
        powers = values[:, None]
    elif intersample == "foh":
        powers = jnp.stack([values, jnp.append(jnp.diff(values), 0.0)], axis=1)
    else:
        powers = spline_coefficients(values)
    count = len(values)
    on = jnp.pad(values, (0, BEYOND), mode="reflect", reflect_type="odd")[count:]
    beyond = jnp.zeros((room - count, powers.shape[1]), values.dtype).at[:BEYOND, 0].set(on)
    return jnp.concatenate([powers, beyond])[:, :, None]
