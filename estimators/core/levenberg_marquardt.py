"""Levenberg and Marquardt's method by optimistix's damped steps, with trials along their arc that are simulated alone.

A pass with the Jacobian takes as long as a dozen simulations. So once a step was too long, how much to damp it is found by
simulations, and the next pass is where the best of them ended.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float
from scipy.optimize import nnls

from estimators.core.concentrated_noise import ConcentratedNoise
from estimators.core.deadline import require_time
from estimators.core.jacobian_factor import Arguments, Factors, Passes, Residuals, promised_gain
from estimators.core.parameter_space import Unknowns
from estimators.core.progress import Tell
from rtac_jax.programs import program
from rtac_jax.programs.arrays import to_jax

# A gain in log-likelihood that moves no parameter by a fiftieth of its standard deviation.
_NOTHING = 2e-4
NEGLIGIBLE = 1e-6
"""Gain in log-likelihood that a last step may promise and need not be taken: none moves a parameter by 0.0015 of its standard
deviation."""
# A step is taken that gains at least this fraction of what it promises (Gould et al., 4OR 3 (2005), as in optimistix).
_WORTH = 0.01
# Damping of a full step, far below what any data say of an unknown that they show; by how much less it is after a step that
# gained what it promised; its factors along the arc, and from what was best last to where the next arc begins.
_FULL, _LESS, _ALONG, _BOLDER = 1.0, 3.5, 8.0, 64.0
# Damping below which nothing creeps any more; and of rounding, as a fraction of a matrix's trace, or of the cost.
_LEAST, _ROUNDING = 1e-12, 1e-12
# Where a channel is left far beyond its noise, steps that promise more and gain less than this fraction of the cost, an rms that
# falls by 0.3 %, so many in a row end the descent: what all steps allowed would gain so is no nearer to the data. Set on one
# fit (a straight spring in place of a sinh), and of 32 drawn rigs none was left farther off by 1.5 % (docs/study_log.md).
_CREEPS, _IN_A_ROW = 6e-3, 3
# A step that gains less than this fraction of what a full one promises was stopped by a kink; of how many points beyond it the
# slopes are counted, too.
_POOR, _BESIDE = 0.1, 3
# Unknowns are padded to one of these numbers, and beyond to multiples of the last, so that all models share a few programs.
_SIZES = (16, 32, 48, 64, 96, 128)


class Solved(NamedTuple):
    """The solution at which Levenberg-Marquardt ended.

    Attributes:
        unknowns: there.
        factor: the triangular factor there, channels as weighted last.
        cost: half the sum of squares, or what stands for those of the channels where they are weighted anew.
        steps: number of passes with the Jacobian after the first.
        converged: whether no step gains more, rather than the number of steps running out.
        squares: sum of squares of each channel's residual, unweighted.
        promised: gain in log-likelihood that the slopes promise there: little at a smooth minimum, more where a kink stopped it.
        pulled: names of the parameters that were left on their bounds although the data pull them inwards.
        held: how many parameters are held on a bound.
        crept: whether it was stopped far from the data, where steps gained next to nothing.
    """

    unknowns: Unknowns
    factor: np.ndarray
    cost: float
    steps: int
    converged: bool
    squares: np.ndarray
    promised: float = 0.0
    pulled: tuple[str, ...] = ()
    held: int = 0
    crept: bool = False


@program
def _damped(factor: Array, damping: Array) -> Array:
    """Return the step of the linearised problem with this damping."""
    unknowns = jnp.zeros(factor.shape[1] - 1)
    told = optx.FunctionInfo.ResidualJac(factor[:, -1], lx.MatrixLinearOperator(factor[:, :-1]))
    descent: Any = optx.DampedNewtonDescent()
    step, _ = descent.step(1.0 / damping, descent.query(unknowns, told, descent.init(unknowns, told)))
    return step


class _Arc:
    """The steps from one point by their damping."""

    def __init__(self, unknowns: Unknowns, triangle: Float[np.ndarray, "every every"]) -> None:
        self._from = unknowns
        self._joined = triangle
        size = self._joined.shape[1] - 1
        room = next((s for s in _SIZES if s >= size), -(-size // _SIZES[-1]) * _SIZES[-1])
        padded = np.zeros((room + 1, room + 1))
        padded[: size + 1, :size] = self._joined[:, :-1]
        padded[: size + 1, -1] = self._joined[:, -1]
        self._padded = to_jax(padded)

    def at(self, damping: float) -> tuple[Unknowns, float]:
        """Return where the step with this damping leads, and by how much it promises to lower the cost."""
        residual, jacobian = self._joined[:, -1], self._joined[:, :-1]
        step = np.asarray(_damped(self._padded, jnp.asarray(damping)))[: jacobian.shape[1]]
        move = jacobian @ step
        parts, first = [], 0
        for leaf in self._from:
            part = step[first : first + np.size(leaf)]
            parts.append(to_jax(np.asarray(leaf) + part.reshape(np.shape(leaf))))
            first += np.size(leaf)
        # Of the difference of two sums of squares, each far larger, rounding would promise something however short the step.
        return Unknowns(*parts), -float(residual @ move + 0.5 * move @ move)


def _triangle_of_all(
    unknowns: Unknowns, factor: Float[np.ndarray, "experiment row column"]
) -> Float[np.ndarray, "every every"]:
    """Return one triangular factor by the unknowns of all experiments, each after the other, and the residual."""
    experiments, rows, _ = factor.shape
    shared, own = len(unknowns.shared), len(unknowns.each) + len(unknowns.start)
    whole = np.zeros((experiments, rows, shared + own * experiments + 1))
    whole[..., :shared], whole[..., -1] = factor[..., :shared], factor[..., -1]
    for column in range(experiments):
        # Rows of `each` and `start` follow each other, each with a place for every experiment.
        whole[column, :, shared + column : -1 : experiments] = factor[column, :, shared:-1]
    found = np.asarray(np.linalg.qr(whole.reshape(-1, whole.shape[2]), mode="r"))
    return np.pad(found, ((0, max(0, found.shape[1] - found.shape[0])), (0, 0)))


def solve(
    unknowns: Unknowns,
    arguments: Arguments,
    *,
    tolerance: float = 1e-6,
    gain: float = NEGLIGIBLE,
    most: int = 60,
    progress: Tell | None = None,
    noise: ConcentratedNoise | None = None,
    far: float = np.inf,
) -> Solved:
    """Minimise the sum of squares.

    Args:
        unknowns: to begin at.
        arguments: of the residual.
        tolerance: relative change of unknowns below which it stops; and of the cost, by a tenth of it twice in a row.
        gain: promised by a full step, below which it stops too.
        most: passes with the Jacobian to try after the first.
        progress: called with a line of text after every one.
        noise: by which channels are weighted, anew at each point, so that its cost is what is minimised; by default they have
            the weights that the arguments give them. A step that lowers the weighted squares lowers that cost, too: the
            logarithm of a channel's squares lies below its tangent.
        far: deviation of any channel, in the unit of its residual, beyond which steps that gain next to nothing end the descent
            where channels are weighted anew.

    Raises:
        FloatingPointError: the model diverges at the very start.
    """
    passes = Passes(arguments)
    here = passes.factors(unknowns)
    if here.diverged:
        raise FloatingPointError(
            "The model diverges at the start values; give start values nearer to the rig, or check the units."
        )
    walk = _Walk(arguments, passes, most)
    quiet, creeping, converged = 0, 0, False
    while True:
        weights = np.ones(len(here.squares)) if noise is None else 1.0 / noise.deviations(here.squares)
        best = here.joined(weights)
        promised = promised_gain(best, len(unknowns.shared))
        converged = converged or quiet >= 2 or promised < gain
        if converged or walk.steps >= most or creeping >= _IN_A_ROW:
            break
        require_time()
        taken = walk.step(unknowns, best, weights, promised)
        if taken is None:
            converged = walk.steps < most
            break
        cost = 0.5 * float(np.sum(best[..., -1] ** 2))
        if progress is not None:
            # Of channels that are weighted anew the cost is always half their number: what is left of them tells.
            left = (
                f"cost {cost - taken.gained:.6g}" if noise is None else f"{_farthest(noise, taken):.6g} times the noise"
            )
            progress(f"step {walk.steps}, {left}")
        beyond = noise is not None and _farthest(noise, taken) > far
        creeping = creeping + 1 if beyond and taken.gained < _CREEPS * cost < promised else 0
        quiet = quiet + 1 if taken.gained < max(0.1 * tolerance * cost, _NOTHING) else 0
        converged = walk.full and _near(taken.unknowns, unknowns, tolerance)
        unknowns, here = taken.unknowns, taken.factors
    cost = _cost(here, weights)
    if noise is not None:
        cost += noise.cost(here.squares) - 0.5 * float(weights**2 @ here.squares)
    crept = not converged and creeping >= _IN_A_ROW
    return Solved(unknowns, best, cost, walk.steps, converged, here.squares, promised, crept=crept)


class _Taken(NamedTuple):
    """A step that was taken: where it led, the factors there, and what it gained."""

    unknowns: Unknowns
    factors: Factors
    gained: float


class _Found(NamedTuple):
    """The best step along an arc, None where none gains anything; what it gains, its damping, and the last that led too far."""

    there: Unknowns | None
    gained: float
    damping: float
    beyond: Unknowns | None


class _Walk:
    """The way from point to point, and what the last steps showed of the damping that the next need.

    Attributes:
        steps: passes with the Jacobian so far.
        full: whether steps are tried as they are, by a pass.
    """

    def __init__(self, arguments: Arguments, passes: Passes, most: int) -> None:
        self.steps, self.full = 0, True
        self._passes, self._most = passes, most
        self._space, self._residuals = arguments.space, Residuals(arguments)
        self._damping, self._mixed = _FULL, _FULL
        self._beside: list[_Taken] = []

    def step(
        self,
        unknowns: Unknowns,
        factor: Float[np.ndarray, "experiment row column"],
        weights: Float[np.ndarray, " output"],
        promised: float,
    ) -> _Taken | None:
        """Return the next step; None where none gains anything, or no pass is left.

        Args:
            unknowns: where it begins.
            factor: there.
            weights: of the channels.
            promised: what a full step promises to gain.
        """
        cost = 0.5 * float(np.sum(factor[..., -1] ** 2))
        here = _triangle_of_all(unknowns, factor)
        arc = _Arc(unknowns, here)
        if self.full:
            # Unknowns with little slope, as near a bound, would creep where the damping holds back more than half of the gain.
            # Those of single experiments may, as nobody holds them on a bound that they overshoot.
            while not unknowns.each.size and self._damping > _LEAST and arc.at(self._damping)[1] < 0.5 * promised:
                self._damping /= _ALONG
            there, expected = arc.at(self._damping)
            tried = self._passed(there, cost, weights)
            if tried.gained > 0 and tried.gained >= _WORTH * expected:
                if tried.gained > (1 - _WORTH) * expected:
                    self._damping /= _LESS
                return tried
            self.full, self._beside = False, []
            self._remember(tried)
            damping = _ALONG * self._damping
        else:
            damping = max(self._damping / _BOLDER, _FULL)
        found = self._along(arc, damping, cost, weights)
        if _BESIDE and found.gained < _POOR * promised and self.steps < self._most:
            # A kink, as dry friction makes them: the step leads along it, where the slopes on its sides cancel.
            if found.beyond is not None:
                self._remember(self._passed(found.beyond, cost, weights))
            several = [here, *(_seen_from(unknowns, one, weights) for one in self._beside)]
            both = self._along(_Arc(unknowns, _together(several, damping)), self._mixed, cost, weights)
            self._mixed = max(both.damping / _BOLDER, _FULL) if both.there is not None else _FULL
            found = max(both, found, key=lambda one: one.gained)
        while found.there is not None and self.steps < self._most:
            taken = self._passed(found.there, cost, weights)
            if taken.gained > 0:
                self._damping, self.full = found.damping, found.damping <= _FULL
                return taken
            found = self._along(arc, _ALONG * found.damping, cost, weights)  # the slopes left all bounds there
        return None

    def _remember(self, beyond: _Taken) -> None:
        if not beyond.factors.diverged:
            self._beside = [*self._beside, beyond][-_BESIDE:]

    def _passed(self, there: Unknowns, cost: float, weights: Float[np.ndarray, " output"]) -> _Taken:
        self.steps += 1
        factors = self._passes.factors(there)
        gained = -np.inf if factors.diverged else cost - _cost(factors, weights)
        return _Taken(there, factors, gained)

    def _along(self, arc: _Arc, damping: float, cost: float, weights: Float[np.ndarray, " output"]) -> _Found:
        """Return the step with the damping, of this or more, from which on more of it gains less, by simulations."""
        found = _Found(None, 0.0, damping, None)
        while True:
            there, promised = arc.at(damping)
            require_time()
            if not promised >= max(
                _NOTHING, _ROUNDING * cost
            ):  # of a huge cost what is promised is never less than rounding
                return found
            gained = cost - self._simulated_cost(there, weights)
            if found.there is not None and gained <= found.gained:
                return found
            if gained >= _WORTH * promised:
                found = _Found(there, gained, damping, found.beyond)
            elif np.isfinite(gained):
                found = found._replace(beyond=there)
            damping *= _ALONG

    def _simulated_cost(self, unknowns: Unknowns, weights: Float[np.ndarray, " output"]) -> float:
        """Return half the sum of squares by a simulation without derivatives; infinite where it diverges."""
        error, known = self._residuals.at(unknowns)
        with np.errstate(over="ignore"):  # of a step that makes the model diverge
            squares = np.sum(error**2, axis=(0, 2))
        cost = 0.5 * float(weights**2 @ squares + np.sum(known**2))
        if self._space.known is not None:
            cost += self._space.penalty(self._space.physical(unknowns)[0])
        return cost if np.isfinite(cost) else np.inf


def _seen_from(
    unknowns: Unknowns, other: _Taken, weights: Float[np.ndarray, " output"]
) -> Float[np.ndarray, "every every"]:
    """Return the triangular factor of all at another point, as the linearised problem there is seen from these unknowns."""
    found = other.factors.joined(weights)
    shared, each, start = (np.asarray(b) - np.asarray(a) for a, b in zip(unknowns, other.unknowns, strict=True))
    experiments = len(found)
    move = np.concatenate([np.broadcast_to(shared[:, None], (len(shared), experiments)), each, start])
    found[..., -1] -= np.einsum("erc,ce->er", found[..., :-1], move)
    return _triangle_of_all(unknowns, found)


def _together(several: Sequence[Float[np.ndarray, "every every"]], damping: float) -> Float[np.ndarray, "every every"]:
    """Return one triangular factor of linearised problems of which each counts so much that together they slope least.

    Source: Wolfe, Mathematical Programming Study 3 (1975): the shortest mixture of subgradients leads along a kink.
    """
    slopes = np.stack([one[:, :-1].T @ one[:, -1] for one in several], axis=1)
    curvature = several[0][:, :-1].T @ several[0][:, :-1]
    curvature += max(damping, _ROUNDING * np.trace(curvature)) * np.eye(len(slopes))
    length = np.linalg.solve(np.linalg.cholesky(curvature), slopes)
    # Fractions that add up to one, as the heavy last row asks.
    heavy = 1e3 * max(float(np.max(np.abs(length))), np.finfo(float).tiny)
    fractions, _ = nnls(np.vstack([length, np.full(len(several), heavy)]), np.append(np.zeros(len(length)), heavy))
    fractions /= np.sum(fractions)
    rows = np.concatenate([np.sqrt(fraction) * one for fraction, one in zip(fractions, several, strict=True)])
    return np.asarray(np.linalg.qr(rows, mode="r"))


def _cost(factors: Factors, weights: Float[np.ndarray, " output"]) -> float:
    return 0.5 * float(weights**2 @ factors.squares + np.sum(factors.prior[..., -1] ** 2))


def _farthest(noise: ConcentratedNoise, taken: _Taken) -> float:
    """Return what is left of the channel that is farthest off, over its noise."""
    return float(np.max(noise.deviations(taken.factors.squares)[noise.counts > 0], initial=0.0))


def _near(one: Unknowns, other: Unknowns, tolerance: float) -> bool:
    """Return whether two points are the same but for this relative difference."""
    return all(
        bool(np.all(np.abs(np.asarray(a) - np.asarray(b)) < tolerance * (1.0 + np.abs(np.asarray(a)))))
        for a, b in zip(one, other, strict=True)
    )
