"""Innovations of a predictor with frozen gains, and how they would change with parameters or added inputs."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from estimators.core.data import CHANNELS, Data
from estimators.core.padded_experiments import padded
from estimators.core.parameter_space import Space
from estimators.core.residual import predict, whitened
from estimators.core.threads import at_once
from estimators.prediction_error.ekf import Filtered
from estimators.prediction_error.force_probe import KNOTS, ForceProbe
from rtac_jax import RTAC
from rtac_jax.programs import program
from rtac_jax.programs.arrays import to_jax
from rtac_jax.simulation import Steps, equations_of

AT_ONCE = 8
DIRECTIONS = 12
"""Directions that are differentiated at a time: as many as an unknown force has heights."""
Rows = Float[np.ndarray, "row column"]


class Innovations:
    """Innovations of a predictor with frozen gains, as a function of parameter values; rows are whitened samples.

    Where constants were measured beforehand, how far each is from that in standard deviations is a row more at the end. So
    a projection on the free parameters leaves of a candidate what neither they nor the constants' errors explain.
    """

    def __init__(self, model: RTAC, data: Data, space: Space, whitener: Array, gain: Array, substeps: Steps) -> None:
        self.model, self.data, self.space = model, data, space
        self.whitener, self.gain, self.substeps = whitener, gain, substeps
        self.used = np.asarray(data.present).any(axis=(0, 2))
        self.weight = np.asarray(data.present)[: data.samples, self.used]
        wide, of_wide, whiteners, gains = padded(data, space.at_given_values(), whitener, gain)
        self._arguments = (equations_of(model), wide, of_wide, whiteners, gains)

    def at(self, values: Float[np.ndarray, "point parameter"]) -> Rows:
        """Return innovations for several sets of shared parameter values, one column each."""

        def some(first: int) -> Rows:
            part = values[first : first + AT_ONCE]
            padded = np.concatenate([part, np.repeat(part[-1:], AT_ONCE - len(part), axis=0)])
            found = np.asarray(_innovations(*self._arguments, to_jax(padded), self.substeps))[: len(part)]
            return self.rows(found, np.stack([self._constants(one) for one in part]))

        return np.concatenate(at_once(some, range(0, len(values), AT_ONCE)), axis=1)

    def jacobian(self) -> Rows:
        """Return derivatives by the free shared parameters, scaled."""
        directions = self._directions()
        slopes = self._constants(directions) - self._constants(np.zeros_like(directions))
        return self._derivatives(slopes, values=directions)

    def pushed(self, current: np.ndarray, force: np.ndarray) -> Rows:
        """Return derivatives by currents [A] and cart forces [N] added to the inputs, each [direction sample experiment]."""
        return self._derivatives(self._constants_of_forces(len(current)), current=current, force=force)

    def by_force(self, probe: ForceProbe) -> Rows:
        """Return derivatives by the heights of an unknown force, one column each."""
        return self._derivatives(self._constants_of_forces(KNOTS), probe, heights=np.eye(KNOTS))

    def _derivatives(self, constants: np.ndarray, probe: ForceProbe | None = None, **along: np.ndarray) -> Rows:
        """Return derivatives along directions, of `_Along`; along what is not given nothing changes."""
        probe = _no_force() if probe is None else probe
        columns = []
        for first in range(0, len(constants), DIRECTIONS):
            part = {name: rows[first : first + DIRECTIONS] for name, rows in along.items()}
            count = len(constants[first : first + DIRECTIONS])
            found = _derivatives(*self._arguments, probe, self._along(**part), self.substeps)
            columns.append(self.rows(np.asarray(found)[:count], constants[first : first + count]))
        return np.concatenate(columns, axis=1)

    def _along(self, **given: np.ndarray) -> "_Along":
        """Return as many directions as are compiled, from the rows that are given; the rest is zero."""
        added = (self.data.room, self.data.experiments)
        shapes = {"values": (len(self.space.names),), "heights": (KNOTS,), "current": added, "force": added}
        found = {}
        for name, shape in shapes.items():
            rows = np.zeros((DIRECTIONS, *shape))
            rows[: len(given.get(name, ()))] = given.get(name, 0.0)
            found[name] = to_jax(rows)
        *_, current, force = padded(self.data, self.space, found["current"], found["force"])
        return _Along(**found | {"current": current, "force": force})

    def compile(self) -> None:
        """Compile `at`, and run nothing."""
        several = np.repeat(np.asarray(self.space.values)[None], AT_ONCE, axis=0)
        _innovations.prepare(*self._arguments, to_jax(several), self.substeps)

    def compile_derivatives(self) -> None:
        """Compile `jacobian`, `pushed` and `by_force`, which are one program; and run nothing."""
        _derivatives.prepare(*self._arguments, _no_force(), self._along(), self.substeps)

    def _directions(self) -> np.ndarray:
        # A free parameter past the end is none: its direction, and so its column, is zero.
        unit = np.eye(len(self.space.names) + 1)[np.asarray(self.space.active), :-1]
        return unit * np.asarray(self.space.scale)

    def rows(self, found: np.ndarray, constants: np.ndarray | None = None) -> Rows:
        """Return whitened samples [direction sample output experiment] as columns, channels that nobody measured left out.

        Rows of an experiment, and within it of a stretch of time, are neighbours.

        Args:
            found: of several directions.
            constants: of each, the rows of constants that were measured beforehand; by default those of the present values.
        """
        there = found[:, : self.data.samples, self.used, : self.data.experiments]
        shown = np.moveaxis(there, 3, 1).reshape(len(found), -1)
        if self.space.known is None:
            return shown.T
        if constants is None:
            constants = np.broadcast_to(self._constants(), (len(found), self._constants().shape[-1]))
        return np.concatenate([shown, constants], axis=1).T

    def _constants_of_forces(self, count: int) -> np.ndarray:
        """Return the rows of constants for so many derivatives by forces, which change no constant: zeros."""
        return np.zeros((count, self._constants().shape[-1]))

    def _constants(self, values: np.ndarray | None = None) -> np.ndarray:
        """Return how far constants are from what was measured beforehand; by default at the present values."""
        at = np.asarray(self.space.values) if values is None else values
        if self.space.known is None or self.space.known_std is None:
            return np.zeros((*at.shape[:-1], 0))
        # Of these only: a model with other effects has more parameters, and its rows have to be the same.
        measured = np.isfinite(np.asarray(self.space.known_std))
        return ((at - np.asarray(self.space.known)) / np.asarray(self.space.known_std))[..., measured]

    def blocks(self) -> np.ndarray:
        """Return for every row the number of the stretch of time that it belongs to; it never falls."""
        samples = np.repeat(stretches(self.data)[: self.data.samples].T.reshape(-1), int(self.used.sum()))
        return np.concatenate([samples, np.repeat(samples[-1:], self._constants().shape[-1])])


def stretches(data: Data, seconds: float = 1.0) -> Int[np.ndarray, "sample experiment"]:
    """Return for every sample and experiment the number of the stretch of time that it belongs to.

    Those of an experiment are equally long, and as near to so many seconds as they can be. Where nothing counts, as beyond the
    end of a short experiment or in a gap, no stretch begins: it would be one that never scatters.
    """
    counts = np.any(np.asarray(data.counted) > 0, axis=1)
    sample_time = np.broadcast_to(np.asarray(data.excitation.sample_time), counts.shape[1:])
    found = np.zeros(counts.shape, dtype=int)
    last = -1
    for column in range(counts.shape[1]):
        there = counts[:, column]
        samples = 1 + np.max(np.flatnonzero(there), initial=0)
        several = max(round(samples * float(sample_time[column]) / seconds), 1)
        within = np.minimum(np.arange(len(there)) * several // samples, several - 1)
        begins = np.bincount(within[there], minlength=several) > 0
        found[:, column] = np.maximum(last + np.cumsum(begins), 0)[within]
        last += int(np.sum(begins))
    return found


def error_at(
    model: RTAC, data: Data, space: Space, whitener: Array, gain: Array, values: Array, substeps: Steps
) -> Array:
    """Return whitened innovations at values of all shared parameters."""
    predicted = predict(model, data, space, (values, space.each_values, space.start), substeps=substeps, gain=gain)
    return whitened(whitener, (data.values - predicted) * data.present)


@program
def _innovations(
    model: RTAC, data: Data, space: Space, whitener: Array, gain: Array, values: Array, substeps: Steps
) -> Array:
    return jax.vmap(lambda v: error_at(model, data, space, whitener, gain, v, substeps))(values)


def _no_force() -> ForceProbe:
    return ForceProbe.between(0, 0, 0.0, 1.0, 1.0)


class _Along(NamedTuple):
    """Directions along which innovations are differentiated.

    Attributes:
        values: of the shared parameters, physical.
        heights: of an unknown force, in its unit.
        current: added to the input [A].
        force: added to the input [N].
    """

    values: Float[Array, "direction parameter"]
    heights: Float[Array, "direction knot"]
    current: Float[Array, "direction sample experiment"]
    force: Float[Array, "direction sample experiment"]


@program
def _derivatives(
    model: RTAC,
    data: Data,
    space: Space,
    whitener: Array,
    gain: Array,
    probe: ForceProbe,
    along: _Along,
    substeps: Steps,
) -> Array:
    """Return the derivatives of the innovations along directions, at no unknown force and at the inputs that were measured.

    All that is linear in the innovations is one program, or each would compile the same physics again.
    """

    def with_added(known: Array | None, added: Array) -> Array:
        # By parts: an addition at an index to zeros would be computed by the compiler, which takes seconds.
        first = added[:, None]
        return first if known is None else jnp.concatenate([known[:, :1] + first, known[:, 1:]], axis=1)

    def function(values: Array, heights: Array, current: Array, force: Array) -> Array:
        probed = model + eqx.tree_at(lambda p: p.heights, probe, heights)
        given = data.excitation
        pushed = dataclasses.replace(
            given, current=with_added(given.current, current), force=with_added(given.force, force)
        )
        changed = dataclasses.replace(data, excitation=pushed)
        return error_at(probed, changed, space, whitener, gain, values, substeps)

    nothing = jnp.zeros((data.room, data.experiments))
    point = (space.values, jnp.zeros(KNOTS), nothing, nothing)
    return jax.vmap(lambda direction: jax.jvp(function, point, tuple(direction))[1])(along)


def orthonormal(columns: Rows) -> Float[np.ndarray, "row basis"]:
    """Return an orthonormal basis of the columns' span."""
    if columns.shape[1] == 0:
        return columns
    size = np.sqrt(np.sum(columns**2, axis=0))
    q, r = np.linalg.qr(columns / np.where(size > 0, size, 1.0))
    return q[:, np.abs(np.diagonal(r)) > 1e-10]


def one_step_rms(passed: Filtered) -> dict[str, float]:
    """Return the rms of the prediction errors one sample ahead, by channel [its unit], over the samples that count."""
    whitener = np.moveaxis(np.asarray(passed.whitener), 3, 1)  # [sample experiment row output]
    there = np.diagonal(whitener, axis1=2, axis2=3) > 0
    # A row of zeros stands for a sample that was not measured.
    square = whitener + np.eye(len(CHANNELS)) * ~there[..., None, :]
    white = np.swapaxes(np.asarray(passed.innovations), 1, 2)[..., None]
    error = np.linalg.solve(square, white)[..., 0]
    return {
        channel: float(np.sqrt(np.mean(error[..., row][there[..., row]] ** 2)))
        for row, channel in enumerate(CHANNELS)
        if there[..., row].any()
    }
