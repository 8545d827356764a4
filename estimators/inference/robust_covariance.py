"""Covariances of a fit that hold when its residual is coloured, beside the plain one."""

import dataclasses
from collections.abc import Mapping
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.stats import t as student

from estimators.core.data import fitted_part, moving, origins
from estimators.core.fisher_information import Information
from estimators.core.fit import Fit
from estimators.core.linearisation import Problem, Rows, at_fit, rows_at
from estimators.core.long_run_covariance import long_run_covariance
from estimators.core.result_base import Result
from estimators.core.results import RESULTS, NotIdentifiableError
from rtac_jax import require_configured
from rtac_jax.arguments import checked_arguments
from rtac_jax.measurement import Recording
from rtac_jax.overview import Overview

_NO_NUMBERS = (
    "covariances: the simulation's derivatives are no numbers where the fit ended, as where a size is off by many orders of "
    "magnitude; look at the units of what was recorded (--scale of rtac import), or fix a parameter (model.fix, or --fix of rtac)."
)

Kind = Literal["plain", "sandwich", "clustered"]
Matrix = Float[np.ndarray, "parameter parameter"]


@dataclasses.dataclass(frozen=True, repr=False)
class Covariances(Result):
    """The result of `covariances`: the uncertainty of one fit's parameters by three sets of assumptions.

    Attributes:
        names: of the parameters.
        values: the estimates, SI units.
        units: SI units.
        plain: the residual is white.
        sandwich: the residual is coloured, and forgets within an experiment.
        clustered: the residual is anything that is independent between experiments.
        degrees: of freedom of Student's distribution, by kind and parameter.
    """

    names: tuple[str, ...]
    values: Float[np.ndarray, " parameter"]
    units: tuple[str, ...]
    plain: Matrix
    sandwich: Matrix
    clustered: Matrix
    degrees: Mapping[str, Float[np.ndarray, " parameter"]]

    def std(self, kind: Kind) -> dict[str, float]:
        """Return the standard deviation of each parameter, SI units.

        NaN where only one experiment shows it and there is nothing to compare.
        """
        with np.errstate(invalid="ignore"):  # rounding of next to nothing may be negative
            return dict(zip(self.names, (float(x) for x in np.sqrt(np.diagonal(getattr(self, kind)))), strict=True))

    def interval(self, kind: Kind, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Return the confidence interval of each parameter."""
        reach = student.ppf(0.5 + 0.5 * level, self.degrees[kind]) * np.array(list(self.std(kind).values()))
        return {n: (float(v - r), float(v + r)) for n, v, r in zip(self.names, self.values, reach, strict=True)}

    def overview(self) -> Overview:
        """Return the standard deviations by all three."""
        by_kind = [self.std(kind) for kind in ("plain", "sandwich", "clustered")]
        rows = [
            (n, f"{v:.6g}", *(f"{std[n]:.2g}" for std in by_kind), u)
            for n, v, u in zip(self.names, self.values, self.units, strict=True)
        ]
        header = ("parameter", "value", "std, white", "std, coloured", "std, independent experiments", "unit")
        return Overview(f"standard deviations of {len(rows)} parameters by three sets of assumptions", header, rows)

    def __str__(self) -> str:
        kinds: tuple[Kind, ...] = ("plain", "sandwich", "clustered")
        lines = [f"{'parameter':28s} {'value':>12s} " + " ".join(f"{k + ' std':>14s}" for k in kinds) + "  unit"]
        each = [self.std(kind) for kind in kinds]
        for name, value, unit in zip(self.names, self.values, self.units, strict=True):
            spreads = " ".join(f"{s[name]:14.2g}" if np.isfinite(s[name]) else f"{'one only':>14s}" for s in each)
            lines.append(f"{name:28s} {value:12.6g} {spreads}  {unit}")
        lines.append("plain: white residual; sandwich: coloured residual; clustered: independent experiments only")
        return "\n".join(lines)


@checked_arguments
def covariances(fit: Fit, recording: Recording) -> Covariances:
    """Compute plain, sandwich and clustered covariance of a fit.

    The sandwich sums the autocovariance of the scores within each experiment under Bartlett's window, as wide as their
    correlation asks, and makes up for what fitting took from the residual; the clustered one takes each experiment's whole
    score as one observation, scaled so that it is right on average when the residual is white, with as many degrees of
    freedom as then match its variance.

    Args:
        fit: of output error.
        recording: the one that was fitted.

    Raises:
        ValueError: the recording is not the one that was fitted.
        NotIdentifiableError: where the fit ended the data leave parameters free, or derivatives are no numbers.

    Source: Newey and West, Econometrica 55 (1987); Andrews, Econometrica 59 (1991); Bell and McCaffrey, Survey
    Methodology 28 (2002).
    """
    require_configured()
    problem = at_fit(fit, recording)
    rows = rows_at(problem)
    if not np.all(np.isfinite(rows.gauss_newton)):
        raise NotIdentifiableError(_NO_NUMBERS)
    meat, bread, independent = _coloured(rows, problem)
    meat = meat * _spent(rows, problem) + rows.known.T @ rows.known
    origin = origins(moving(fitted_part(recording, fit.experiments)))
    clusters = [origin[name] for name in fit.experiments]
    by_cluster, degrees = clustered(_of_experiments(fit.information, rows), clusters)
    # What was measured of constants beforehand is another observation, whose variance is known.
    own = fit.information.own_covariance
    by_cluster = by_cluster + own @ rows.known.T @ rows.known @ own
    names = fit.information.names
    from_held = fit.information.covariance - own
    # Of a robust fit the derivative of a score is less than its weight.
    meat = meat * fit.statistics.get("score_ratio", 1.0) ** 2
    many = np.full(len(names), np.inf)
    return Covariances(
        names,
        np.array([fit.parameters[n].value for n in names]),
        tuple(fit.parameters[n].unit for n in names),
        fit.information.covariance,
        bread @ meat @ bread + from_held,
        by_cluster + from_held,
        {"plain": many, "sandwich": np.full(len(names), max(1.5 * independent, 3.0)), "clustered": degrees},
    )


def _of_experiments(information: Information, rows: Rows) -> Information:
    """Return scores and parts of the experiments alone, without their fractions of what was measured of constants beforehand."""
    if not len(rows.known) or information.parts is None or information.scores is None:
        return information
    fraction = 1.0 / len(information.scores)
    return dataclasses.replace(
        information,
        parts=information.parts - fraction * rows.known.T @ rows.known,
        scores=information.scores - fraction * rows.known.T @ rows.known_residual,
    )


def _coloured(rows: Rows, problem: Problem) -> tuple[Matrix, Matrix, float]:
    """Return the sum of the scores' autocovariance, the inverse of the Gauss-Newton matrix, and the number of stretches.

    A stretch has as many samples as lags are summed; how many that is, is chosen for each sample time by itself.
    """
    scores = np.einsum("sokp,sok->ksp", rows.jacobian, rows.residual)
    try:
        bread = np.linalg.inv(rows.gauss_newton)
    except np.linalg.LinAlgError:
        raise NotIdentifiableError(f"covariances: {RESULTS[RESULTS.undetermined]}") from None
    meat = np.zeros(rows.gauss_newton.shape)
    independent = 0.0
    interval = np.array([e.sample_time for e in problem.experiments])
    for one in np.unique(interval):
        alike = np.flatnonzero(interval == one)
        longest = max(problem.experiments[column].samples for column in alike)
        own, lag = long_run_covariance(scores[alike, :longest])
        meat = meat + own
        independent += float(np.sum(np.asarray(problem.arguments.data.present)[..., alike])) / (lag + 1)
    return meat, bread, independent


def _spent(rows: Rows, problem: Problem) -> float:
    """Return the factor by which fitting made the squared residual smaller.

    A coloured residual of n samples is worth fewer, and all unknowns fit it.
    """
    power = float(np.sum(rows.residual**2))
    rho = float(np.clip(np.sum(rows.residual[1:] * rows.residual[:-1]) / power, 0.0, 0.99)) if power > 0 else 0.0
    worth = float(np.sum(np.asarray(problem.arguments.data.present))) * (1 - rho) / (1 + rho)
    starts = float(np.sum(1 - np.asarray(problem.arguments.space.start_held)))
    fitted = len(problem.names) + np.size(problem.unknowns.each) + starts
    return worth / max(worth - fitted, 0.5 * worth)


def clustered(information: Information, clusters: list[str]) -> tuple[Matrix, Float[np.ndarray, " parameter"]]:
    """Return the covariance from the scores of independent clusters, and degrees of freedom per parameter.

    Args:
        information: with scores and parts of every experiment.
        clusters: to which cluster each of the information's experiments belongs.

    Raises:
        ValueError: there are no scores, or as many labels as experiments are not given.
    """
    if information.parts is None or information.scores is None:
        raise ValueError("this information holds no scores of single experiments, so it cannot be clustered.")
    if len(clusters) != len(information.scores):
        raise ValueError(f"{len(information.scores)} experiments need as many clusters, not {len(clusters)}.")
    groups = list(dict.fromkeys(clusters))
    place = np.array([groups.index(c) for c in clusters])
    parts = np.stack([information.parts[place == g].sum(axis=0) for g in range(len(groups))])
    scores = np.stack([information.scores[place == g].sum(axis=0) for g in range(len(groups))])
    bread = information.own_covariance
    moved = scores @ bread  # what each cluster moves each parameter by, but for the sign
    raw = moved.T @ moved
    # Were the residual white, cluster g's fraction of parameter p would be c' B (s_g - H_g B sum s) with Cov(s_g) = H_g.
    # Its covariance over clusters tells how far the raw variance is off, and how much it scatters.
    width = len(information.names)
    scale, degrees = np.full(width, np.nan), np.full(width, np.nan)
    for p in range(width):
        c = bread[p]
        through = np.einsum("q,gqr,rs->gs", c, parts, bread)
        own = np.einsum("q,gqr,r->g", c, parts, c)
        omega = np.diag(own) - np.einsum("gs,hst,t->gh", through, parts, c)
        trace, white = float(np.trace(omega)), float(np.sum(own))  # white: the variance if the residual is
        if 0 < 1e-9 * white < trace:  # of a fit that ran away neither need be a number above zero
            scale[p] = np.sqrt(white / trace)
            degrees[p] = trace**2 / float(np.sum(omega**2))
    return raw * np.outer(scale, scale), degrees
