"""One recording among many that are fitted at once: data, unknowns, bounds and noise, a column for each experiment."""

import dataclasses
import functools
from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from estimators.core.active_bounds import OFF_BOUNDS
from estimators.core.data import CHANNELS, Data, moving, pieces
from estimators.core.initial_state import space_in_numpy
from estimators.core.parameter_space import Space, unconstrained_in_numpy
from estimators.core.sensor_noise import noise_levels
from estimators.output_error.normal_equations import Columns
from rtac_jax import RTAC
from rtac_jax.measurement import Experiment, Recording


@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    """A recording, and the model that is fitted to it.

    All of it follows from the two alone, so that a fit does not depend on what is fitted beside it.

    Attributes:
        model: that is fitted.
        experiments: those that move, cut into pieces.
        space: of the unknowns.
        shared: names of the free parameters that all experiments share.
        held: names of the parameters that are not estimated.
        outputs: places of the measured channels.
        data: the measurements.
        columns: how the unknowns of each experiment are placed and scaled.
        unknowns: at which the fit begins: shared parameters, those of each experiment, states at the start.
        noise: of the sensors [output 1].
        kind: what cases of one batch have in common: structure of the model, names, lengths, inputs and outputs.
    """

    model: RTAC
    experiments: tuple[Experiment, ...]
    space: Space
    shared: tuple[str, ...]
    held: tuple[str, ...]
    outputs: tuple[int, ...]
    data: Data
    columns: Columns
    unknowns: Float[np.ndarray, "unknown experiment"]
    noise: Float[np.ndarray, "output 1"]
    kind: Hashable

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the parameters among the unknowns, the shared ones first."""
        return (*self.shared, *self.space.each)

    @classmethod
    def of(cls, model: RTAC, recording: Recording, start: Mapping[str, float] | None = None) -> "Case":
        """Prepare the fit of a model to a recording.

        Args:
            model: whose free parameters are estimated, at the values where the fit begins.
            recording: with moving experiments.
            start: values of some free parameters to begin at instead.

        Raises:
            ValueError: nothing moves, or no free parameter is shared by the experiments.
        """
        experiments = tuple(pieces(moving(recording)))
        shared = tuple(name for name in model.free if name not in model.per_experiment)
        if not shared:
            raise ValueError(
                "The model has no free parameter that experiments share; release one with model.release(name)."
            )
        outputs = tuple(place for place, c in enumerate(CHANNELS) if any(c in e.outputs for e in experiments))
        levels = noise_levels(recording.experiments)
        space = space_in_numpy(model, experiments, free=list(shared))
        held, known = tuple(name for name in space.names if name not in shared), model.values
        count = len(experiments)

        def each(rows: np.ndarray | list[float]) -> np.ndarray:
            return np.repeat(np.asarray(rows, dtype=float)[:, None], count, axis=1)

        active = np.asarray(space.active)
        bounds = [
            np.concatenate([np.asarray(own)[active], np.asarray(of_each)])
            for own, of_each in (
                (space.lower, space.each_lower),
                (space.upper, space.each_upper),
                (space.scale, space.each_scale),
            )
        ]
        columns = Columns(
            *(each(bound) for bound in bounds),
            *(np.asarray(x) for x in (space.start, space.start_scale, space.start_spread, space.start_held)),
            known=each([float(known[name]) for name in held]).reshape(len(held), count),
        )
        common, own = unconstrained_in_numpy(_started(space, start or {}), off_bounds=OFF_BOUNDS)
        unknowns = np.concatenate([each(common), own, np.zeros_like(space.start)])
        data = Data.in_numpy(experiments)
        return cls(
            model, experiments, space, shared, held, outputs, data, columns, unknowns,
            np.array([[levels.get(CHANNELS[place], 1.0)] for place in outputs]),
            _kind(model, experiments, (*shared, *held), data),
        )  # fmt: skip


def _started(space: Space, start: Mapping[str, float]) -> Space:
    """Return the space at other values of some shared parameters."""
    if not start:
        return space
    values = np.asarray(space.values).copy()
    for name, value in start.items():
        values[space.names.index(name)] = value
    return eqx.tree_at(lambda one: one.values, space, values)


def shape_of(experiments: Sequence[Experiment]) -> tuple[tuple[object, ...], ...]:
    """Return what the experiments of recordings that are fitted at once have in common."""
    return tuple((e.name, e.samples, e.arm, e.cart, tuple(e.inputs), tuple(e.outputs)) for e in experiments)


def _kind(model: RTAC, experiments: Sequence[Experiment], given: Sequence[str], data: Data) -> Hashable:
    # What is no parameter of its own, such as the table of a force, stands in the compiled code once for all columns.
    leaves, structure = jax.tree.flatten(model)
    own = _parameters_among(structure, len(leaves), (*given, *sorted(model.per_experiment)))
    marks = tuple((np.shape(x), None if n in own else np.asarray(x).tobytes()) for n, x in enumerate(leaves))
    shapes = tuple(np.shape(leaf) for leaf in jax.tree.leaves(data))
    return structure, marks, shape_of(experiments), jax.tree.structure(data), shapes


@functools.lru_cache(maxsize=64)
def _parameters_among(structure: Any, count: int, names: tuple[str, ...]) -> frozenset[int]:
    """Return the places of these parameters among the leaves of a model."""
    zeros = jax.tree.unflatten(structure, [np.zeros(())] * count)
    ones = jax.tree.leaves(zeros.with_values(dict.fromkeys(names, 1.0)))
    return frozenset(n for n, leaf in enumerate(ones) if np.all(np.asarray(leaf) == 1.0))
