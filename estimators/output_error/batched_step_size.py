"""Step size of many fits at once: for each the rule of `accurate_substeps`, by simulations side by side."""

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from estimators.core.residual import states_at_start
from estimators.core.step_size import MOST_SUBSTEPS, STEP_ERROR
from estimators.output_error.fit_case import Case
from estimators.output_error.normal_equations import Columns, physical
from estimators.output_error.side_by_side import places_for, side_by_side
from rtac_jax import RTAC, Excitation
from rtac_jax.programs import program
from rtac_jax.programs.arrays import to_jax
from rtac_jax.simulation import Steps, rate_jacobians, substeps_at, trajectories

_TOGETHER = 32  # models whose rates are computed at once


def substeps_of(cases: Sequence[Case]) -> list[int]:
    """Return for each case the fewest Runge-Kutta steps per sample that are accurate enough where its fit begins.

    Args:
        cases: of one kind.
    """
    counts = stable_substeps([case.model for case in cases], [case.data.excitation for case in cases])
    coarse: dict[int, np.ndarray] = {}
    looked_at = list(range(len(cases)))
    while looked_at:
        again: list[int] = []
        for count in sorted({counts[number] for number in looked_at}):
            here = [number for number in looked_at if counts[number] == count]
            unknown = [number for number in here if number not in coarse]
            coarse.update(zip(unknown, _simulated([cases[n] for n in unknown], count), strict=True))
            for number, fine in zip(here, _simulated([cases[n] for n in here], 2 * count), strict=True):
                if np.all(np.isfinite(fine)) and not _alike(cases[number], coarse[number], fine):
                    counts[number], coarse[number] = 2 * count, fine
                    if 2 * count < MOST_SUBSTEPS:
                        again.append(number)
        looked_at = again
    return counts


def stable_substeps(models: Sequence[RTAC], excitations: Sequence[Excitation], *, stability: float = 1.0) -> list[int]:
    """Return for each model what `rtac_jax.simulation.substeps_for` does, from Jacobians that are computed together."""
    groups: dict[Any, list[int]] = defaultdict(list)
    for number, model in enumerate(models):
        groups[jax.tree.structure(model)].append(number)
    counts = [1] * len(models)
    for numbers in groups.values():
        for first in range(0, len(numbers), _TOGETHER):
            here = numbers[first : first + _TOGETHER]
            padded = [*here, *[here[-1]] * (_TOGETHER - len(here))]
            stacked = jax.tree.map(lambda *x: np.stack([np.ravel(one)[0] for one in x]), *(models[n] for n in padded))
            jacobians = np.asarray(_rate_jacobians(jax.tree.map(to_jax, stacked)))[: len(here)]
            fastest = np.max(np.abs(np.linalg.eigvals(jacobians)), axis=(1, 2))
            for number, rate in zip(here, fastest, strict=True):
                counts[number] = substeps_at(float(rate), excitations[number], stability=stability)
    return counts


@program
def _rate_jacobians(models: RTAC) -> Float[Array, "model angle state state"]:
    return jax.vmap(rate_jacobians)(models)


def _alike(case: Case, coarse: np.ndarray, fine: np.ndarray) -> bool:
    samples, outputs = slice(int(case.data.length)), list(case.outputs)
    present = case.data.present[samples, outputs]
    errors = (fine[samples, outputs] - coarse[samples, outputs]) * (present / case.noise)
    squares, count = np.einsum("soe,soe->oe", errors, errors), present.sum(axis=0)
    interval = np.asarray(case.data.excitation.sample_time)
    # Apart by sample time: in the mean over all, many short steps would hide that few long ones are too long.
    alike = [interval == one for one in set(interval.tolist())]
    change = [np.sqrt(squares[:, c].sum(axis=1) / np.maximum(count[:, c].sum(axis=1), 1.0)) for c in alike]
    return bool(np.all(np.array(change) < STEP_ERROR))


def _simulated(cases: Sequence[Case], substeps: int) -> list[Float[np.ndarray, "sample output experiment"]]:
    """Return the outputs of each case at its beginning."""
    found: list[np.ndarray] = []
    for first in range(0, len(cases), size := places_for(len(cases[0].experiments)) if cases else 1):
        here = cases[first : first + size]
        padded = [*here, *[here[-1]] * (size - len(here))]
        parts = side_by_side([(c.data.excitation, c.columns, c.unknowns) for c in padded])
        excitation, columns, unknowns = jax.tree.map(to_jax, parts)
        one: Any = here[0]
        shown = np.asarray(
            _outputs(
                one.model, one.names, one.held, one.data.room, excitation, columns, unknowns,
                jnp.asarray(one.data.length), jnp.asarray(substeps),
            )
        )  # fmt: skip
        width = len(one.experiments)
        found += [shown[..., place * width : (place + 1) * width] for place in range(len(here))]
    return found


@program
def _outputs(
    model: RTAC,
    names: tuple[str, ...],
    held: tuple[str, ...],
    room: int,
    excitation: Excitation,
    columns: Columns,
    unknowns: Array,
    samples: Steps,
    substeps: Steps,
) -> Array:
    values, start = physical(columns, unknowns)
    here = model.with_values(dict(zip((*held, *names), (*columns.known, *values), strict=True)))
    state = states_at_start(here, start, excitation)
    return trajectories(here, state, excitation, samples=samples, room=room, substeps=substeps)
