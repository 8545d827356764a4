"""The triangular factors of residual and Jacobian, by experiment and channel: all of a pass that an optimiser needs."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from estimators.core.data import Data
from estimators.core.padded_experiments import experiments_at, padded, space_at
from estimators.core.parameter_space import Space, Unknowns
from estimators.core.piecewise_triangle import piecewise_triangle, worth_cutting
from estimators.core.residual import residual, triangle
from estimators.core.threads import at_once
from rtac_jax import RTAC
from rtac_jax.programs import program
from rtac_jax.programs.arrays import to_jax
from rtac_jax.simulation import Steps, equations_of

_HOPELESS = 1e30
# Singular values of less than this fraction of the largest are of unknowns that do nothing.
_RANK = 1e-12
# Experiments from which on two halves of them are passed through side by side, one core for each: fewer leave vectors half empty.
_HALVED = 8


class Arguments(eqx.Module):
    """All that the residual needs beside the unknowns; a change of values never compiles again."""

    model: RTAC
    data: Data
    space: Space
    whitener: Array
    gain: Array | None
    substeps: Steps = eqx.field(converter=jnp.asarray)


@dataclasses.dataclass(frozen=True)
class Factors:
    """The triangular factors of [J, r], Jacobian and residual, at one point.

    Columns are the shared unknowns, the experiment's own, its start, and last the residual.

    Attributes:
        channels: of each experiment and channel.
        prior: rows of what was known beforehand, of each experiment.
    """

    channels: Float[np.ndarray, "experiment output row column"]
    prior: Float[np.ndarray, "experiment known column"]

    @property
    def diverged(self) -> bool:
        """Return whether they are of a model that left all bounds, or whose slopes did."""
        return bool(np.max(np.abs(self.channels)) >= _HOPELESS)

    @property
    def squares(self) -> Float[np.ndarray, " output"]:
        """Return the sum of squares of each channel's residual."""
        return np.sum(self.channels[..., -1] ** 2, axis=(0, 2))

    def joined(self, weights: Float[np.ndarray, " output"] | None = None) -> Float[np.ndarray, "experiment row column"]:
        """Return one factor for each experiment, with the residuals of channels times these weights."""
        scaled = self.channels if weights is None else self.channels * weights[:, None, None]
        rows = np.concatenate([scaled.reshape(len(scaled), -1, scaled.shape[-1]), self.prior], axis=1)
        found = np.asarray(np.linalg.qr(rows, mode="r"))
        # A positive diagonal makes them continuous functions of the unknowns.
        return found * np.where(np.diagonal(found, axis1=1, axis2=2) < 0, -1.0, 1.0)[:, :, None]


@program
def _factors(unknowns: Unknowns, arguments: Arguments) -> tuple[Array, Array]:
    compressed = piecewise_triangle if worth_cutting(arguments.model, arguments.data) else triangle
    channels, prior = compressed(
        arguments.model,
        arguments.data,
        arguments.space,
        unknowns,
        arguments.whitener,
        substeps=arguments.substeps,
        gain=arguments.gain,
    )
    # A trial step that makes the model diverge must look worse than any other, not like nothing.
    finite = jnp.all(jnp.isfinite(channels)) & jnp.all(jnp.isfinite(prior))
    hopeless = jnp.zeros_like(channels).at[..., -1, -1].set(_HOPELESS)
    return jnp.where(finite, channels, hopeless), jnp.where(finite, prior, 0.0)


class Passes:
    """The passes through the data of one problem, two halves of many experiments side by side.

    Halves are taken whatever the number of cores, so that numbers do not depend on it. All problems of a model run one program, be
    they of a simulation, whose channels have one whitener, or of predictions, whose states at the start are no unknowns.
    """

    def __init__(self, arguments: Arguments) -> None:
        arguments = dataclasses.replace(arguments, model=equations_of(arguments.model))
        data, whitener = arguments.data, arguments.whitener
        self._all = data.experiments
        self._parts = [slice(None)]
        if not worth_cutting(arguments.model, data):
            if len(whitener) == 1:
                whitener = jnp.broadcast_to(whitener, (data.room, *whitener.shape[1:]))
                arguments = dataclasses.replace(arguments, whitener=whitener)
            if self._all >= _HALVED:
                # Of equal sizes, or each would be compiled: the one in the middle of an odd number is in both.
                half = (self._all + 1) // 2
                self._parts = [slice(half), slice(self._all - half, self._all)]
        self._arguments = [_padded(_columns(arguments, part)) for part in self._parts]

    def prepare(self, unknowns: Unknowns) -> None:
        """Compile what `factors` will run, and run nothing."""
        _factors.prepare(*self._given(unknowns, 0))

    def factors(self, unknowns: Unknowns) -> Factors:
        """Return the factors at these unknowns."""
        own, start = len(unknowns.shared) + len(unknowns.each), len(unknowns.start)

        def of(number: int) -> tuple[np.ndarray, np.ndarray]:
            channels, prior = map(np.array, _factors(*self._given(unknowns, number)))
            part = len(range(self._all)[self._parts[number]])
            if len(channels) > part:  # the experiments were padded
                prior[:, start:] *= np.sqrt(len(channels) / part)
                channels, prior = channels[:part], prior[:part]
            if not start:  # the columns of what is held, and the rows of what would be known of it
                held = len(self._arguments[number].space.start)
                channels, prior = (np.delete(rows, np.s_[own : own + held], axis=-1) for rows in (channels, prior))
                prior = prior[:, held:]
            return channels, prior

        found = at_once(of, range(len(self._parts)))
        if len(found) == 1:
            return Factors(*found[0])
        # Each half counts what was measured of constants as if it were all experiments.
        for channels, prior in found:
            prior[:, start:] *= np.sqrt(len(channels) / self._all)
        twice = 2 * len(found[0][0]) - self._all
        return Factors(*(np.concatenate([first, second[twice:]]) for first, second in zip(*found, strict=True)))

    def _given(self, unknowns: Unknowns, number: int) -> tuple[Unknowns, Arguments]:
        """Return the unknowns and the arguments of a part, with states at the start that are held where they are no unknowns."""
        part, arguments = self._parts[number], self._arguments[number]
        unknowns = _padded_unknowns(unknowns, np.arange(self._all)[part], arguments.data.experiments)
        if len(unknowns.start):
            return unknowns, arguments
        space = arguments.space
        held = dataclasses.replace(space, start_held=jnp.ones_like(space.start_held))
        return (
            unknowns._replace(start=to_jax(np.zeros(np.shape(space.start)))),
            dataclasses.replace(arguments, space=held),
        )


def _columns(arguments: Arguments, places: slice) -> Arguments:
    """Return the arguments of the experiments at some places."""
    if places == slice(None):
        return arguments
    return dataclasses.replace(
        arguments,
        data=experiments_at(arguments.data, places),
        space=space_at(arguments.space, places),
        whitener=experiments_at(arguments.whitener, places),
        gain=experiments_at(arguments.gain, places),
    )


def _padded(arguments: Arguments) -> Arguments:
    """Return the arguments with their experiments `padded`."""
    a = arguments
    data, space, whitener, gain = padded(a.data, a.space, a.whitener, a.gain)
    return dataclasses.replace(a, data=data, space=space, whitener=whitener, gain=gain)


def _padded_unknowns(unknowns: Unknowns, places: np.ndarray, count: int) -> Unknowns:
    """Return the unknowns of the experiments at some places, those of the last repeated up to a number."""
    at = np.pad(places, (0, count - len(places)), mode="edge")
    return unknowns._replace(each=experiments_at(unknowns.each, at), start=experiments_at(unknowns.start, at))


def factor(unknowns: Unknowns, arguments: Arguments) -> Float[np.ndarray, "experiment row column"]:
    """Return the triangular factor of residual and Jacobian of each experiment; see `Factors`."""
    return Passes(arguments).factors(unknowns).joined()


def diverged(factor: Float[np.ndarray, "experiment row column"]) -> bool:
    """Return whether the factor is that of a model that left all bounds."""
    return bool(np.max(np.asarray(factor)[:, -1, -1]) >= _HOPELESS)


@program
def _residual(unknowns: Unknowns, arguments: Arguments) -> tuple[Array, Array]:
    a = arguments
    return residual(a.model, a.data, a.space, unknowns, a.whitener, substeps=a.substeps, gain=a.gain)


class Residuals:
    """The residuals of one problem, whose experiments are padded once."""

    def __init__(self, arguments: Arguments) -> None:
        self._count = arguments.data.experiments
        self._arguments = dataclasses.replace(_padded(arguments), model=equations_of(arguments.model))

    def at(
        self, unknowns: Unknowns
    ) -> tuple[Float[np.ndarray, "sample output experiment"], Float[np.ndarray, "start experiment"]]:
        """Return the residual itself and the deviation of the starts from what is known of them; see `residual`."""
        given = _padded_unknowns(unknowns, np.arange(self._count), self._arguments.data.experiments)
        error, known = map(np.asarray, _residual(given, self._arguments))
        return error[..., : self._count], known[..., : self._count]


def plain_residual(
    unknowns: Unknowns, arguments: Arguments
) -> tuple[Float[np.ndarray, "sample output experiment"], Float[np.ndarray, "start experiment"]]:
    """Return what `Residuals` do, where one point is asked of a problem."""
    return Residuals(arguments).at(unknowns)


def promised_gain(factor: np.ndarray, shared: int) -> float:
    """Return the gain in log-likelihood that a full step of Gauss and Newton promises: half the squared Newton decrement.

    Args:
        factor: the triangular factors of residual and Jacobian, per experiment.
        shared: number of unknowns that all experiments share; they come first.

    Source: Boyd and Vandenberghe, Convex Optimization (2004), section 9.5.1.
    """
    residual = factor[..., -1:]
    both = np.concatenate([factor[..., :shared], residual], axis=-1)
    # What each experiment has for itself explains its part first; the shared unknowns part of what is left.
    basis = _basis(factor[..., shared:-1])
    part = np.swapaxes(basis, -1, -2) @ both
    left = (both - basis @ part).reshape(-1, shared + 1)
    together = _basis(left[:, :-1]).T @ left[:, -1]
    return 0.5 * float(np.sum(part[..., -1] ** 2) + together @ together)


def _basis(columns: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of what the columns of matrices span, with zeros in place of what they do not."""
    if columns.shape[-1] == 0:
        return columns
    left, size, _ = np.linalg.svd(columns, full_matrices=False)
    counts = size > _RANK * np.maximum(size[..., :1], np.finfo(float).tiny)
    return left * counts[..., None, :]
