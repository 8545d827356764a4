"""Screening of the candidate set by the equations of motion, where no simulation of the base model follows the recording."""

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

from estimators.closed_form.motion_regression import Columned, MotionRegression, Solution
from rtac_jax.effects import Effect
from rtac_jax.parameters import declarations


@dataclasses.dataclass(frozen=True)
class Explained:
    """The part of the equation error that a candidate of one shape explains.

    Attributes:
        id: of the effect.
        instance: the effect of that shape, at a plausible size.
        amplitudes: its amplitude parameters.
        begin: their estimates.
        values: estimates of the base model's parameters beside it.
        statistic: its gain in BIC of the equations; of a selected one beyond those that were selected before it.
        selected: whether the forward selection took it.
    """

    id: str
    instance: Effect
    amplitudes: tuple[str, ...]
    begin: Float[np.ndarray, " amplitude"]
    values: Mapping[str, float]
    statistic: float
    selected: bool

    @property
    def p_value(self) -> float:
        """Return the probability of so large a gain by chance at most, with a degree of freedom for each amplitude."""
        return float(chi2.sf(max(self.statistic, 0.0), len(self.amplitudes)))


def explained_by(
    equations: MotionRegression, instances: Sequence[Effect], *, least: float, most: int
) -> list[Explained]:
    """Select candidates forwards by what they take off the equation error beyond the price of their parameters and shapes.

    Args:
        equations: of the base model.
        instances: the candidates, every shape of them at a plausible size; what is no function of the motion is passed over.
        least: gain in BIC that one more must reach.
        most: candidates that are selected.

    Returns:
        The selected ones in their order, then the best shape of each other that gains by itself, the best first; all at estimates
        without the others, as they are refitted one after the other.

    Source: Miller, Subset Selection in Regression (2002), chapter 3; Schwarz, Annals of Statistics 6 (1978), for BIC.
    """
    several = [one for instance in instances for one in equations.beside(instance)]
    shapes = Counter(_id(one) for one in several)
    base = equations.solved()
    alone: dict[str, _Tried] = {}
    chosen: list[Columned] = []
    gains: dict[str, float] = {}
    now = base
    while len(chosen) < most:
        taken = {_id(one) for one in chosen}
        tried = [
            t
            for one in several
            if _id(one) not in taken and (t := _tried(equations, now, chosen, one, shapes[_id(one)])) is not None
        ]
        if not chosen:
            for t in tried:
                if t.gain > (alone[_id(t.one)].gain if _id(t.one) in alone else 0.0):
                    alone[_id(t.one)] = t
        found = max(tried, key=lambda t: t.gain, default=None)
        if found is None or found.gain <= least:
            break
        gains[_id(found.one)] = found.gain
        chosen.append(found.one)
        now = found.solution
    others = sorted((name for name in alone if name not in gains), key=lambda name: -alone[name].gain)
    selected = [_described(alone[name], gain) for name, gain in gains.items() if name in alone]
    return selected + [_described(alone[name], None) for name in others]


class _Tried(NamedTuple):
    gain: float
    one: Columned
    solution: Solution


def _id(one: Columned) -> str:
    return one.regressor.instance.id


def _tried(
    equations: MotionRegression, now: Solution, chosen: Sequence[Columned], one: Columned, shapes: int
) -> _Tried | None:
    """Return what one candidate more gains; None where its size or that of another is none that it can have.

    The best of several shapes gains by chance as much as twice the logarithm of their number.
    """
    several = [*chosen, one]
    solution = equations.solved(several)
    for each, amplitudes in zip(several, _shared_out(several, solution), strict=True):
        declared = declarations(each.regressor.instance)
        bounds = [declared[name].bounds for name in each.regressor.amplitudes]
        if any(not low <= value <= high for value, (low, high) in zip(amplitudes, bounds, strict=True)):
            return None
    gain = equations.gain(now, solution, len(type(one.regressor.instance).amplitudes())) - 2.0 * np.log(shapes)
    return _Tried(float(gain), one, solution)


def _shared_out(several: Sequence[Columned], solution: Solution) -> list[np.ndarray]:
    """Return of each effect its amplitudes."""
    edges = np.cumsum([len(one.regressor.amplitudes) for one in several])[:-1]
    return np.split(solution.amplitudes, edges)


def _described(tried: _Tried, gain: float | None) -> Explained:
    """Return the record of a candidate from its solution without others.

    The gain is that of the step that selected it; None where none did.
    """
    instance, amplitudes = tried.one.regressor.instance, tried.solution.amplitudes
    names = type(instance).amplitudes()
    if not tried.one.regressor.amplitudes:
        amplitudes = np.array([float(np.asarray(getattr(instance, name))) for name in names])
    known = tried.gain if gain is None else gain
    return Explained(instance.id, instance, names, amplitudes, tried.solution.values, known, gain is not None)
