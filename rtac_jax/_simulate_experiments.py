"""Simulate the experiments of a recording."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, overload

import numpy as np
from jaxtyping import Array

from rtac_jax._rtac import RTAC
from rtac_jax._run import run, whole_starts
from rtac_jax._simulation_record import Simulation, simulation_of
from rtac_jax.arguments import checked_arguments
from rtac_jax.configuration import warn_single_precision
from rtac_jax.effect_contract import require_working_model
from rtac_jax.equations import sensor_outputs
from rtac_jax.excitation import BEYOND, Excitation
from rtac_jax.measurement import Experiment
from rtac_jax.time_loop import room_for

Starts = Mapping[str, Sequence[Any] | np.ndarray | Array]


@overload
def simulate(
    model: RTAC, experiments: Experiment, *, start: Starts | None = None, substeps: int | None = None
) -> Simulation: ...
@overload
def simulate(
    model: RTAC, experiments: Iterable[Experiment], *, start: Starts | None = None, substeps: int | None = None
) -> dict[str, Simulation]: ...
@checked_arguments
def simulate(
    model: RTAC,
    experiments: Experiment | Iterable[Experiment],
    *,
    start: Starts | None = None,
    substeps: int | None = None,
) -> Simulation | dict[str, Simulation]:
    """Simulate experiments of any lengths, sample times and inputs in one call.

    It may be traced: `jax.jit`, `jax.vmap`, `jax.jacfwd` and `jax.grad` work by the model's values and by the start. A
    batch over parameter sets is one call:

        def position(values):
            return rtac.simulate(model.with_values(values), experiment).cart_position

        sets = {"spring_stiffness": jnp.linspace(120.0, 140.0, 64)}
        positions = jax.jit(jax.vmap(position))(sets)  # [64 sample]

    Args:
        model: at the values to simulate with.
        experiments: a recording, or some of its experiments, or one experiment; their inputs, holds and lengths are taken,
            their outputs not.
        start: cart position [m], cart velocity [m/s], arm angle [rad] and arm velocity [rad/s] at the start, by name of
            experiment; what is not named starts at rest in the origin at its `initial_arm_angle`. More than four numbers
            give every state of the model.
        substeps: Runge-Kutta steps per sample; by default as the fastest mode asks, in a batch the fastest of all.

    Returns:
        By name of experiment; of one experiment its simulation.

    Raises:
        ValueError: no experiment, a start of the wrong length, less than one step in a sample, or a user's own effect that does
            not work.
    """
    warn_single_precision()
    require_working_model(model)
    chosen = [experiments] if isinstance(experiments, Experiment) else list(experiments)
    if not chosen:
        raise ValueError("simulate needs at least one experiment.")
    samples = max(e.samples for e in chosen)
    room = room_for(samples + BEYOND)
    excitation = Excitation.of(chosen, room=room)
    given = start or {}
    starts = [given.get(e.name, (0.0, 0.0, e.initial_arm_angle or 0.0, 0.0)) for e in chosen]
    table = whole_starts(model, starts, [f"experiment {e.name}" for e in chosen], excitation)
    states = run(model, table, excitation, room=room, samples=samples, substeps=substeps)
    outputs = sensor_outputs(model, tuple(states[:, row] for row in range(states.shape[1])))
    simulations = {e.name: simulation_of(model, states, outputs, column, e.time) for column, e in enumerate(chosen)}
    return simulations[chosen[0].name] if isinstance(experiments, Experiment) else simulations
