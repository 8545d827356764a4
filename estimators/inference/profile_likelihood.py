"""Profile likelihood: the fall of the likelihood as one parameter is held and all the rest is fitted again."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq
from scipy.stats import chi2

from estimators.core.active_bounds import OFF_BOUNDS, solve_bounded
from estimators.core.data import CHANNELS
from estimators.core.drawing import draw
from estimators.core.fit import Fit
from estimators.core.linearisation import at_fit, problem_of
from rtac_jax import require_configured
from rtac_jax.arguments import checked_arguments
from rtac_jax.measurement import Recording


@dataclasses.dataclass(frozen=True)
class Profile:
    """The result of `profile`.

    Attributes:
        name: of the parameter.
        unit: SI unit.
        value: the estimate.
        std: its standard deviation from the curvature at the estimate.
        held: values at which the parameter was held.
        rise: of twice the negative log-likelihood above its minimum, at each of them.
        interval: where the rise stays below the level's quantile, up to the parameter's bounds; infinite where it never crosses it.
        level: of the interval.
    """

    name: str
    unit: str
    value: float
    std: float
    held: Float[np.ndarray, " point"]
    rise: Float[np.ndarray, " point"]
    interval: tuple[float, float]
    level: float

    def __str__(self) -> str:
        low, high = self.interval
        text = f"{self.name} = {self.value:.6g} {self.unit}; {100 * self.level:.3g} % interval {low:.6g} to {high:.6g}"
        below, above = (self.value - low) / self.std, (high - self.value) / self.std
        if not np.isfinite(below + above):
            return f"{text}: the data do not bound it on {'both sides' if np.isinf(below) and np.isinf(above) else 'one side'}."
        reach = float(np.sqrt(chi2.ppf(self.level, 1)))
        skewed = max(abs(below / reach - 1), abs(above / reach - 1)) > 0.1
        return text + (", not that of a parabola: trust it rather than the standard deviation." if skewed else ".")

    def plot(self) -> Any:
        """Draw the profile beside the parabola of the standard deviation, as a matplotlib figure."""
        return draw(self)


@checked_arguments
def profile(
    fit: Fit,
    recording: Recording,
    name: str,
    *,
    points: int = 9,
    reach: float = 3.0,
    level: float = 0.95,
    steps: int = 30,
) -> Profile:
    """Compute the profile likelihood of one parameter of a fit, with its interval.

    Args:
        fit: of output error.
        recording: the one that was fitted.
        name: of the parameter.
        points: values at which it is held, spread evenly over `reach` standard deviations to both sides.
        reach: in standard deviations, to each side of the estimate.
        level: of the interval.
        steps: optimiser steps at each point.

    Raises:
        ValueError: the fit did not estimate the parameter, or the recording is not the one that was fitted.
        RuntimeError: JAX was not configured for double precision.

    Source: Venzon and Moolgavkar, Applied Statistics 37 (1988).
    """
    require_configured()
    if name not in fit.information.names:
        raise ValueError(f"the fit did not estimate {name!r}; it estimated {', '.join(fit.information.names)}.")
    if points < 3 or not 0 < level < 1 or reach <= 0:
        raise ValueError("profile needs three points or more, a positive reach, and a level between 0 and 1.")
    needed = float(np.sqrt(chi2.ppf(level, 1)))
    if reach < needed:
        raise ValueError(f"reach is {reach:g}; an interval at {100 * level:g} % needs {needed:.2f} or more.")
    # What is held is held in the profile, too, as exact.
    place, own = fit.information.names.index(name), fit.information.own_covariance
    value, std = fit.parameters[name].value, float(np.sqrt(own[place, place]))
    lower, upper = fit.model.parameters[name].bounds
    whole = at_fit(fit, recording, off_bounds=OFF_BOUNDS)
    deviation = np.array([fit.residual_std.get(channel, 1.0) for channel in CHANNELS])
    best = solve_bounded(whole.unknowns, whole.arguments, tolerance=1e-8, most=steps)
    offsets = np.linspace(-reach, reach, points + (points + 1) % 2) * std
    offsets = offsets[(value + offsets > lower) & (value + offsets < upper)]
    correlated = own[:, place] / std**2
    # Off its bound a friction level finds back over a kink, or not: from one that lies near it both are tried.
    kept = {n: float(fit.parameters[n].value) for n in fit.information.names if n != name and _near_bound(fit, n)}

    def cost(values: dict[str, float]) -> float:
        """Return the cost with the parameter held, all else fitted again from these values."""
        problem = problem_of(
            fit.model.with_values(values), whole.experiments, deviation, substeps=int(fit.statistics["substeps"]),
            start=fit.start, off_bounds=OFF_BOUNDS,
        )  # fmt: skip
        # A place past the end holds the parameter at the space's value; the fit's compiled function serves again.
        space = problem.arguments.space
        active = np.asarray(space.active).copy()
        active[problem.names.index(name)] = len(space.names)
        held = dataclasses.replace(problem.arguments, space=dataclasses.replace(space, active=jnp.asarray(active)))
        return solve_bounded(problem.unknowns, held, tolerance=1e-8, most=steps).cost

    rise = np.zeros(len(offsets))
    for place in np.flatnonzero(offsets):
        # The others begin where the ridge of the likelihood leads, as its curvature has it.
        moved = {
            n: float(np.clip(fit.parameters[n].value + c * offsets[place], *fit.model.parameters[n].bounds))
            for n, c in zip(fit.information.names, correlated, strict=True)
        } | {name: value + offsets[place]}
        starts = (moved, moved | kept) if kept else (moved,)
        rise[place] = 2 * (min(map(cost, starts)) - best.cost)
    return Profile(
        name,
        fit.parameters[name].unit,
        value,
        std,
        value + offsets,
        rise,
        _interval(value, offsets, rise, level, ends=(lower, upper), reach=reach * std),
        level,
    )


def _near_bound(fit: Fit, name: str) -> bool:
    """Return whether a bound of a parameter lies within three deviations of its estimate."""
    at = fit.parameters[name]
    return any(abs(at.value - end) < 3 * at.std for end in fit.model.parameters[name].bounds)


def _interval(
    value: float, offsets: np.ndarray, rise: np.ndarray, level: float, *, ends: tuple[float, float], reach: float
) -> tuple[float, float]:
    """Return where the signed root of the rise, which is nearly a straight line, crosses the quantile's root.

    Args:
        value: the estimate.
        offsets: from it, at which the rise is known.
        rise: there.
        level: of the interval.
        ends: the parameter's bounds, where the interval ends at the latest.
        reach: how far to each side it was looked, unless a bound came first.
    """
    root = np.sign(offsets) * np.sqrt(np.maximum(rise, 0.0))
    bound = float(np.sqrt(chi2.ppf(level, 1)))
    found = []
    for side, end in zip((-1, 1), ends, strict=True):
        reached = root[-1] if side > 0 else -root[0]
        if reached < bound:
            found.append(end if side * (end - value) < reach else side * np.inf)
            continue
        far = offsets[-1] if side > 0 else offsets[0]
        crossing = brentq(lambda x, s=side: float(np.interp(x, offsets, root)) - s * bound, 0.0, far)
        found.append(value + float(np.asarray(crossing)))
    return found[0], found[1]
