"""Linearisation of a fit at its solution, set up again for what is asked of it afterwards."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from estimators.core.data import CHANNELS, Data, is_among, mark_of, moving, pieces
from estimators.core.fisher_information import slope_of
from estimators.core.fit import Fit
from estimators.core.initial_state import space_of
from estimators.core.jacobian_factor import Arguments, plain_residual
from estimators.core.parameter_space import Unknowns
from estimators.core.residual import diagonal_whitener, no_gain, residual
from rtac_jax import RTAC
from rtac_jax.measurement import Experiment, Recording
from rtac_jax.programs import program
from rtac_jax.programs.arrays import to_jax


class Problem(NamedTuple):
    """A residual and the point at which it is linearised.

    Attributes:
        arguments: of the residual.
        unknowns: the point.
        experiments: or pieces of them, in the order of the data.
        names: of the free shared parameters.
    """

    arguments: Arguments
    unknowns: Unknowns
    experiments: tuple[Experiment, ...]
    names: tuple[str, ...]


def at_fit(fit: Fit, recording: Recording, *, off_bounds: float = 0.0) -> Problem:
    """Return the problem that gave this fit, at its solution.

    Args:
        fit: of `output_error`.
        recording: that was fitted.
        off_bounds: as `Space.unconstrained` takes it, for a fit that goes on from there.

    Raises:
        ValueError: the recording is not the one that was fitted.
    """
    # Beside longer ones that were not fitted, what was would be cut otherwise.
    fitted = [e for e in moving(recording) if is_among(e, fit.experiments)]
    by_name = {e.name: e for e in pieces(fitted)}
    missing = [name for name in fit.experiments if name not in by_name]
    if missing:
        raise ValueError(
            f"the fit used {', '.join(missing)}, which this recording does not hold; give the recording that was fitted."
        )
    experiments = [by_name[name] for name in fit.experiments]
    other = [e.name for e in experiments if fit.marks.get(e.name) != mark_of(e)]
    if other:
        hum = ", or that without its hum of the mains (recording.without_hum())" if recording.hum() else ""
        raise ValueError(
            f"{other[0]} was fitted with other measurements than this recording holds; give the recording that was fitted{hum}."
        )
    deviation = np.array([fit.residual_std.get(channel, 1.0) for channel in CHANNELS])
    substeps = int(fit.statistics["substeps"])
    found = problem_of(fit.model, experiments, deviation, substeps=substeps, start=fit.start, off_bounds=off_bounds)
    return found if not fit.weights else found._replace(arguments=_weighted(found.arguments, fit, experiments))


def _weighted(arguments: Arguments, fit: Fit, experiments: Sequence[Experiment]) -> Arguments:
    """Return the problem with the weights of a robust fit."""
    present = np.asarray(arguments.data.present).copy()
    for column, e in enumerate(experiments):
        present[: e.samples, :, column] *= np.sqrt(fit.weights[e.name])
    return dataclasses.replace(arguments, data=dataclasses.replace(arguments.data, present=to_jax(present)))


def problem_of(
    model: RTAC,
    experiments: Sequence[Experiment],
    deviation: Float[np.ndarray, " output"],
    *,
    substeps: int,
    start: Mapping[str, np.ndarray] | None = None,
    off_bounds: float = 0.0,
) -> Problem:
    """Return the simulation error of a model at its own values, and at these states at the start.

    Args:
        model: at its values.
        experiments: or pieces of them.
        deviation: standard deviation of each output, SI units.
        substeps: of the integrator in each sample.
        start: states at the start by experiment, SI units; by default as the first samples show them.
        off_bounds: as `Space.unconstrained` takes it.
    """
    free = [n for n in model.free if n not in model.per_experiment]
    space = space_of(model, experiments, free=free)
    data = Data.of(experiments)
    unknowns = space.unconstrained(off_bounds=off_bounds)
    if start is not None:
        wanted = np.stack([np.asarray(start[e.name]) for e in experiments], axis=1)
        moved = (wanted - np.asarray(space.start)) / np.asarray(space.start_scale)
        unknowns = unknowns._replace(start=to_jax(np.where(np.asarray(space.start_held) > 0, 0.0, moved)))
    arguments = Arguments(model, data, space, diagonal_whitener(deviation, data), no_gain(model, data), substeps)
    names = tuple(space.names[int(i)] for i in np.asarray(space.active))
    return Problem(arguments, unknowns, tuple(experiments), names)


class Rows(NamedTuple):
    """The whitened residual and its Jacobian by the shared parameters, with each experiment's own unknowns projected away.

    Attributes:
        jacobian: by physical parameters.
        residual: whitened; zero where nothing was measured.
        known: slopes of how far constants are from what was measured of them beforehand, in standard deviations.
        known_residual: these themselves.
    """

    jacobian: Float[np.ndarray, "sample output experiment parameter"]
    residual: Float[np.ndarray, "sample output experiment"]
    known: Float[np.ndarray, "constant parameter"]
    known_residual: Float[np.ndarray, " constant"]

    @property
    def gauss_newton(self) -> Float[np.ndarray, "parameter parameter"]:
        """Return the Gauss-Newton matrix, constants included."""
        flat = self.jacobian.reshape(-1, self.jacobian.shape[-1])
        return flat.T @ flat + self.known.T @ self.known


@program
def _columns(unknowns: Unknowns, arguments: Arguments) -> tuple[Array, Array]:
    """Return derivatives of the residual and of the starts' prior along each unknown of all experiments at once."""
    a = arguments
    edges = np.cumsum([0, *(leaf.shape[0] for leaf in unknowns)])

    def at_point(at: Unknowns) -> tuple[Array, Array]:
        return residual(a.model, a.data, a.space, at, a.whitener, substeps=a.substeps, gain=a.gain)

    def along(direction: Array) -> tuple[Array, Array]:
        parts = [direction[edges[i] : edges[i + 1]] for i in range(3)]
        tangent = Unknowns(
            parts[0], *(jnp.broadcast_to(p[:, None], x.shape) for p, x in zip(parts[1:], unknowns[1:], strict=True))
        )
        return jax.jvp(at_point, (unknowns,), (tangent,))[1]

    return jax.lax.optimization_barrier(jax.vmap(along)(jnp.eye(int(edges[-1]))))


def rows_at(problem: Problem) -> Rows:
    """Return residual and Jacobian of every sample, in physical parameters.

    The Jacobian is held whole: samples times outputs times experiments times parameters numbers.
    """
    unknowns, arguments = problem.unknowns, problem.arguments
    slopes, known_slopes = (np.moveaxis(np.asarray(x), 0, -1) for x in _columns(unknowns, arguments))
    value = np.asarray(plain_residual(unknowns, arguments)[0])
    shared = len(problem.unknowns.shared)
    steepness = slope_of(problem.arguments.space, problem.unknowns)[: len(problem.names)]
    samples, outputs, count, _ = slopes.shape
    jacobian = np.zeros((samples, outputs, count, shared))
    for i in range(count):
        block = slopes[:, :, i].reshape(samples * outputs, -1)
        prior = known_slopes[:, i]
        whole = np.concatenate([block, prior])
        own = whole[:, shared:]
        if own.shape[1]:
            basis, _ = np.linalg.qr(own)
            whole = whole[:, :shared] - basis @ (basis.T @ whole[:, :shared])
        jacobian[:, :, i] = whole[: samples * outputs, :shared].reshape(samples, outputs, shared)
    space, free = arguments.space, np.asarray(arguments.space.active)[: len(problem.names)]
    told = np.asarray(space.from_known(space.physical(unknowns)[0]))
    known = np.zeros((len(told), len(problem.names)))
    if space.known_std is not None:
        known[free, np.arange(len(free))] = 1.0 / np.asarray(space.known_std)[free]
    return Rows(jacobian[..., : len(problem.names)] / steepness, value, known, told)


def with_outputs(problem: Problem, values: Array) -> Arguments:
    """Return the same problem for other measurements [sample output experiment]."""
    data = dataclasses.replace(problem.arguments.data, values=values * (problem.arguments.data.present > 0))
    return dataclasses.replace(problem.arguments, data=data)
