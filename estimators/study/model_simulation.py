"""Simulations of many models of one structure side by side: the truth of a study where it is the model itself."""

from collections import defaultdict
from collections.abc import Hashable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from estimators.core.data import CHANNELS
from estimators.output_error.batched_step_size import stable_substeps
from estimators.output_error.fit_case import shape_of
from estimators.output_error.side_by_side import places_for, side_by_side
from rtac_jax import RTAC, Excitation
from rtac_jax.equations import state_at_start
from rtac_jax.excitation import BEYOND
from rtac_jax.measurement import Experiment
from rtac_jax.programs import program
from rtac_jax.programs.arrays import to_jax
from rtac_jax.simulation import Steps, trajectories
from rtac_jax.time_loop import room_for

# Step times fastest rate; a classic Runge-Kutta step then errs by 0.5^5 / 120 of what that mode moves, as `rtac.simulate` has it.
_STABILITY = 0.5


class Simulated(NamedTuple):
    """One model, and what is played on it.

    Attributes:
        model: that moves.
        experiments: their inputs, holds and lengths are taken, their outputs not.
        start: cart position [m], cart velocity [m/s], arm angle [rad] and arm velocity [rad/s] of each experiment.
    """

    model: RTAC
    experiments: Sequence[Experiment]
    start: Sequence[Sequence[float]]


def simulate_together(jobs: Sequence[Simulated]) -> list[list[dict[str, np.ndarray]]]:
    """Return the outputs of every experiment of every job, by channel; each has the same bits in any company.

    Args:
        jobs: of models whose parameters may differ.
    """
    groups: dict[Hashable, list[int]] = defaultdict(list)
    made = [_columns(job) for job in jobs]
    substeps = stable_substeps([job.model for job in jobs], [one[0] for one in made], stability=_STABILITY)
    for number, (job, (excitation, _, _), steps) in enumerate(zip(jobs, made, substeps, strict=True)):
        shapes = tuple(np.shape(leaf) for leaf in jax.tree.leaves(excitation))
        key = steps, jax.tree.structure((job.model, excitation)), shapes, shape_of(job.experiments)
        groups[key].append(number)
    found: dict[int, list[dict[str, np.ndarray]]] = {}
    for key, numbers in groups.items():
        steps, width = key[0], len(jobs[numbers[0]].experiments)  # type: ignore[index] - a tuple, as above
        size = places_for(width)
        for first in range(0, len(numbers), size):
            here = numbers[first : first + size]
            padded = [*here, *[here[-1]] * (size - len(here))]
            excitation, start, values = jax.tree.map(to_jax, side_by_side([made[number] for number in padded]))
            job = jobs[here[0]]
            samples = max(e.samples for e in job.experiments)
            names = tuple(job.model.parameters)
            room = room_for(samples + BEYOND)
            shown = np.asarray(
                _shown(job.model, names, room, excitation, start, values, jnp.asarray(samples), jnp.asarray(steps))
            )
            for place, number in enumerate(here):
                found[number] = [
                    {channel: shown[: e.samples, row, place * width + column] for row, channel in enumerate(CHANNELS)}
                    for column, e in enumerate(jobs[number].experiments)
                ]
    return [found[number] for number in range(len(jobs))]


def _columns(
    job: Simulated,
) -> tuple[Excitation, Float[np.ndarray, "4 experiment"], Float[np.ndarray, "name experiment"]]:
    samples = max(e.samples for e in job.experiments)
    excitation = Excitation.in_numpy(job.experiments, room=room_for(samples + BEYOND))
    values = np.array([float(value) for value in job.model.values.values()])
    start = np.asarray(job.start, dtype=float).T
    return excitation, start, np.repeat(values[:, None], len(job.experiments), axis=1)


@program
def _shown(
    model: RTAC,
    names: tuple[str, ...],
    room: int,
    excitation: Excitation,
    start: Array,
    values: Array,
    samples: Steps,
    substeps: Steps,
) -> Array:
    here = model.with_values(dict(zip(names, values, strict=True)))
    state = state_at_start(here, tuple(start), excitation.first_current())
    return trajectories(here, state, excitation, samples=samples, substeps=substeps, room=room)
