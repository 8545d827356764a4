"""optimistix's Levenberg-Marquardt on the compressed residual, one step at a time so that progress shows."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array

from estimators.core.data import Data
from estimators.core.parameter_space import Space, Unknowns
from estimators.core.piecewise_triangle import piecewise_triangle, worth_cutting
from estimators.core.residual import residual, triangle
from rtac_jax import RTAC
from rtac_jax.programs import program
from rtac_jax.simulation import Steps

_HOPELESS = 1e30
# A gain in log-likelihood that moves no parameter by a fiftieth of its standard deviation.
_NOTHING = 2e-4
NEGLIGIBLE = 1e-6
"""Gain in log-likelihood that a last step may promise and need not be taken: none moves a parameter by 0.0015 of its standard
deviation."""
# Singular values of less than this fraction of the largest are of unknowns that do nothing.
_RANK = 1e-12


class Arguments(eqx.Module):
    """All that the residual needs beside the unknowns; a change of values never compiles again."""

    model: RTAC
    data: Data
    space: Space
    whitener: Array
    gain: Array | None
    substeps: Steps = eqx.field(converter=jnp.asarray)


def _factor(unknowns: Unknowns, arguments: Arguments) -> Array:
    compressed = piecewise_triangle if worth_cutting(arguments.model, arguments.data) else triangle
    factor = compressed(
        arguments.model,
        arguments.data,
        arguments.space,
        unknowns,
        arguments.whitener,
        substeps=arguments.substeps,
        gain=arguments.gain,
    )
    # A trial step that makes the model diverge must look worse than any other, not like nothing.
    return jnp.where(jnp.all(jnp.isfinite(factor)), factor, jnp.zeros_like(factor).at[:, -1, -1].set(_HOPELESS))


@program
def factor(unknowns: Unknowns, arguments: Arguments) -> Array:
    """Return the triangular factor of residual and Jacobian, per experiment; see `triangle`."""
    return _factor(unknowns, arguments)


def diverged(factor: Array) -> bool:
    """Return whether the factor is that of a model that left all bounds."""
    return bool(np.max(np.asarray(factor)[:, -1, -1]) >= _HOPELESS)


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


@program
def plain_residual(unknowns: Unknowns, arguments: Arguments) -> tuple[Array, Array]:
    """Return the residual itself and the deviation of the starts from what is known of them; see `residual`."""
    a = arguments
    return residual(a.model, a.data, a.space, unknowns, a.whitener, substeps=a.substeps, gain=a.gain)


def _linearised(unknowns: Unknowns, at: tuple[Unknowns, Array]) -> tuple[Array, None]:
    """Return the compressed residual near a point where its triangular factor is known.

    The optimiser asks for value and Jacobian at that point only, so the heavy function is compiled once, apart from the
    optimiser.
    """
    point, factor = at
    shared, each, start = (now - then for now, then in zip(unknowns, point, strict=True))
    own = jnp.concatenate([jnp.broadcast_to(shared[:, None], (len(shared), factor.shape[0])), each, start])
    return factor[..., -1] + jnp.einsum("brc,cb->br", factor[..., :-1], own), None


_OPTIONS = {"jac": "bwd"}  # gives the Jacobian as an array, which a compiled step can take and return


@program
def _init(solver: Any, unknowns: Unknowns, factor: Array) -> Any:
    shape = jax.eval_shape(lambda: factor[..., -1])
    return solver.init(_linearised, unknowns, (unknowns, factor), _OPTIONS, shape, None, frozenset())


@program
def _step(solver: Any, unknowns: Unknowns, state: Any, factor: Array) -> tuple[Unknowns, Any, Array]:
    at = (state.y_eval, factor)
    unknowns, state, _ = solver.step(_linearised, unknowns, at, _OPTIONS, state, frozenset())
    return unknowns, state, 0.5 * jnp.sum(state.f_info.residual**2)


def _largest(tree: Any) -> Array:
    """Return the largest absolute element; optimistix's own norm cannot take empty arrays."""
    leaves = [jnp.max(jnp.abs(leaf)) for leaf in jax.tree.leaves(tree) if leaf.size]
    return jnp.max(jnp.stack(leaves)) if leaves else jnp.zeros(())


class Solved(NamedTuple):
    """The solution at which Levenberg-Marquardt ended.

    Attributes:
        unknowns: there.
        factor: the triangular factor there.
        cost: half the sum of squares.
        steps: number of steps tried.
        converged: whether steps and residual stopped changing, rather than the number of steps running out.
        pulled: whether a parameter was left on its bound although the data pull it inwards.
    """

    unknowns: Unknowns
    factor: np.ndarray
    cost: float
    steps: int
    converged: bool
    pulled: bool = False


def solve(
    unknowns: Unknowns,
    arguments: Arguments,
    *,
    tolerance: float = 1e-6,
    gain: float = NEGLIGIBLE,
    most: int = 60,
    progress: Any = None,
) -> Solved:
    """Minimise the sum of squares.

    Args:
        unknowns: to begin at.
        arguments: of the residual.
        tolerance: relative change of unknowns and residual below which it stops.
        gain: promised by a full step, below which it stops too.
        most: steps to try.
        progress: called with a line of text after every step.

    Raises:
        FloatingPointError: the model diverges at the very start.
    """
    small: Any = jnp.asarray(tolerance)  # an array, or every tolerance would compile its own step
    solver = optx.LevenbergMarquardt(rtol=small, atol=small, norm=_largest)
    trial = factor(unknowns, arguments)
    if diverged(trial):
        raise FloatingPointError(
            "The model diverges at the start values; give start values nearer to the rig, or check the units."
        )
    best, shared = np.asarray(trial), len(unknowns.shared)
    if promised_gain(best, shared) < gain:
        return Solved(unknowns, best, 0.5 * float(np.sum(best[..., -1] ** 2)), 0, True)
    state = _init(solver, unknowns, trial)
    cost, quiet, converged, step = np.inf, 0, False, 0
    for step in range(1, most + 1):
        before = unknowns
        unknowns, state, value = _step(solver, unknowns, state, trial)
        now = float(value)
        taken = not _same(unknowns, before)
        if taken:
            best = np.asarray(trial)
        if progress is not None:
            progress(f"step {step}, cost {now:.6g}")
        if now < cost:
            quiet = quiet + 1 if cost - now < max(0.1 * tolerance * now, _NOTHING) else 0
            cost = now
        if bool(state.terminate) or quiet >= 2 or (taken and promised_gain(best, shared) < gain):
            converged = True
            break
        trial = factor(state.y_eval, arguments)
    return Solved(unknowns, best, cost, step, converged)


def _same(one: Unknowns, other: Unknowns) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))
