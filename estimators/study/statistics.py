"""Statistics over the repetitions of a study: bias, scatter, coverage with its own interval."""

import numpy as np
import scipy.stats

from estimators.study.kept import Kept
from estimators.study.labelled import Labelled

LEVEL = 0.95
"""Of the intervals whose coverage is counted, and of the interval of the coverage."""


def summary(results: Kept, level: float = LEVEL) -> dict[str, Labelled]:
    """Return statistics over the repetitions, each by estimator and parameter.

    Args:
        results: of the study.
        level: of the intervals whose coverage is counted [1].

    Returns:
        `truth`: mean; `bias`: mean error; `bias_std`: its standard deviation; `std`: found, over the repetitions, of the error;
        `rms_error`; `stated_std`: root mean square of the stated ones; `coverage` of the stated intervals, with
        `coverage_low` and `coverage_high` of Clopper and Pearson at the same level; `consistency`: mean of the paper's measure;
        `count` of repetitions that have an estimate, `judged` of those whose interval is counted. Intervals are those of Student's
        distribution with the degrees of freedom that the method states (`results["freedom"]`). NaN where there is none, or it was
        not kept.
    """
    axes = ("estimator", "parameter")
    shape = tuple(len(results.layout.coordinates[axis]) for axis in axes)
    nothing = np.full((len(results.index), *shape), np.nan)
    estimate, std, freedom, consistency = (
        results.arrays.get(name, nothing) for name in ("estimate", "std", "freedom", "consistency")
    )
    truth = np.broadcast_to(results.arrays["truth"][:, None, :], nothing.shape)
    error = estimate - truth
    known = np.isfinite(error)
    count = known.sum(axis=0)
    mean = _mean(error, known)
    scatter = np.sqrt(_mean((error - mean) ** 2, known) * count / np.where(count > 1, count - 1, np.nan))
    judged = known & np.isfinite(std) & (freedom > 0)
    reach = scipy.stats.t.ppf(0.5 + 0.5 * level, np.where(judged, freedom, 1.0)) * std
    inside = np.sum(judged & (np.abs(error) <= np.where(judged, reach, 0.0)), axis=0)
    trials = judged.sum(axis=0)
    low, high = clopper_pearson(inside, trials, level)
    with np.errstate(invalid="ignore"):
        found = {
            "truth": _mean(truth, known),
            "bias": mean,
            "bias_std": scatter / np.sqrt(np.where(count, count, np.nan)),
            "std": scatter,
            "rms_error": np.sqrt(_mean(error**2, known)),
            "stated_std": np.sqrt(_mean(std**2, judged)),
            "coverage": inside / np.where(trials, trials, np.nan),
            "coverage_low": low,
            "coverage_high": high,
            "consistency": _mean(consistency, np.isfinite(consistency)),
            "count": count.astype(float),
            "judged": trials.astype(float),
        }
    places = {axis: results.layout.coordinates[axis] for axis in axes}
    return {name: Labelled(values, axes, places) for name, values in found.items()}


def quantities(results: Kept) -> dict[str, Labelled]:
    """Return mean and standard deviation over the repetitions of what methods give besides parameters."""
    axes = ("estimator", "quantity")
    values = results.arrays.get("quantities")
    if values is None:
        return {}
    known = np.isfinite(values)
    mean = _mean(values, known)
    places = {axis: results.layout.coordinates[axis] for axis in axes}
    spread = np.sqrt(_mean((values - mean) ** 2, known))
    return {"mean": Labelled(mean, axes, places), "std": Labelled(spread, axes, places)}


def envelope_coverage(results: Kept, estimator: str | None = None, level: float = LEVEL) -> dict[str, float]:
    """Return how often an envelope holds what it states: the fraction of new conditions inside beside the stated probability.

    Returns:
        `stated`: mean probability; `inside`: mean fraction of new conditions; `kept`: fraction of envelopes of which at
        least the stated fraction of new conditions lies inside, with `kept_low` and `kept_high`; `confidence`: what it should
        reach.

    Raises:
        ValueError: the study made no envelopes.
    """
    names = [one.name for one in results.spec.estimate if one.method == "envelope"]
    if not names or "quantities" not in results.arrays:
        raise ValueError("this study kept no envelopes.")
    column = results["quantities"].sel(estimator=estimator or names[0])
    stated, inside, confidence = (column.sel(quantity=q).values for q in ("stated", "inside", "confidence"))
    known = np.isfinite(inside)
    kept = np.sum(inside[known] >= stated[known])
    low, high = clopper_pearson(np.asarray(kept), np.asarray(known.sum()), level)
    if not known.any():
        raise ValueError("no envelope was made: every repetition failed.")
    return {
        "stated": float(np.mean(stated[known])), "inside": float(np.mean(inside[known])),
        "kept": float(kept / known.sum()), "kept_low": float(low), "kept_high": float(high),
        "confidence": float(np.mean(confidence[known])),
    }  # fmt: skip


def clopper_pearson(inside: np.ndarray, trials: np.ndarray, level: float = LEVEL) -> tuple[np.ndarray, np.ndarray]:
    """Confidence interval of a probability from how often something happened; NaN without trials.

    Source: Clopper and Pearson, Biometrika 26 (1934).
    """
    tail = 0.5 * (1 - level)
    with np.errstate(invalid="ignore"):
        low = np.where(inside > 0, scipy.stats.beta.ppf(tail, np.maximum(inside, 1), trials - inside + 1), 0.0)
        high = np.where(
            inside < trials, scipy.stats.beta.ppf(1 - tail, inside + 1, np.maximum(trials - inside, 1)), 1.0
        )
    return np.where(trials > 0, low, np.nan), np.where(trials > 0, high, np.nan)


def _mean(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Over the repetitions where it is known; NaN where it never is."""
    count = known.sum(axis=0)
    return np.where(known, values, 0.0).sum(axis=0) / np.where(count, count, np.nan)
