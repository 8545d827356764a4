"""Results as dictionaries, for JSON."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from estimators.core.correlation import LAGS
from estimators.core.fit import Fit, Parameter
from estimators.core.information_criteria import InformationCriteria
from estimators.diagnosis.candidate import Candidate
from estimators.diagnosis.diagnosis import Diagnosis
from estimators.diagnosis.improvement import Improvement
from estimators.experiment_design.next_experiment import NextExperiment
from estimators.reporting.fit_table import AllEstimates
from estimators.reporting.html import cleaned
from estimators.reporting.tables import every_parameter
from estimators.validation.recommendation import Recommendation
from estimators.validation.simulation_error import Compared, Comparison, Trace

FORMAT, VERSION = "rtac-report", 1


def report_dict(
    found: Diagnosis | Improvement,
    *,
    fit: Fit | None = None,
    train: Comparison | None = None,
    validation: Comparison | None = None,
    planned: NextExperiment | None = None,
    seconds: float | None = None,
    advice: Recommendation | None = None,
) -> dict[str, Any]:
    """Return what a diagnosis or an improvement found, ready for `write_json`.

    Args:
        found: a diagnosis or an improvement.
        fit: whose parameters to give; of an improvement by default the last one.
        train: the base model and, after it, the model with the effect, on the fitted data; an improvement brings its own.
        validation: the same on the held-out data.
        planned: the experiment that would tell the rest apart.
        seconds: duration of everything; by default what the result says of itself.
        advice: which estimates of the last model to use.
    """
    if isinstance(found, Improvement):
        fit = fit or found.final
        train, validation = train or found.train, validation or found.validation
        first = found.diagnoses[0]
        named = found.added
        known = every_parameter(found.final)
    else:
        first, named, known = found, found.effects, {}
    learned, nearest = (found.learned, found.nearest) if isinstance(found, Improvement) else (None, None)
    effects = [_effect(candidate, known) for candidate in named]
    accepted = {effect["id"] for effect in effects}
    return cleaned(
        {
            "format": FORMAT,
            "version": VERSION,
            "verdict": found.verdict,
            "mended": found.mended if isinstance(found, Improvement) else None,
            "effects": effects,
            "candidates": [_candidate(c, c.id in accepted) for c in first.candidates],
            "parameters": _parameters(every_parameter(fit)) if fit is not None else {},
            "error": {"train": _before_after(train), "validation": _before_after(validation)},
            "next_experiment": planned.as_dict() if planned is not None else None,
            "seconds": found.seconds if seconds is None else seconds,
            "policy": first.policy.as_dict(),
            "consequence": _consequence(first),
            "learned_force": learned.as_dict() if learned is not None else None,
            "likely_effect": _effect(nearest, known) if nearest is not None else None,
            "recommended": _recommended(advice) if advice is not None else None,
            "varying": found.constancy.as_dict() if isinstance(found, Improvement) and found.constancy else None,
            "left_out": found.left_out if isinstance(found, Improvement) else None,
            "broken_off": bool(found.broken_off),
        }
    )


def fit_dict(
    fit: Fit,
    *,
    train: Comparison,
    validation: Comparison | None,
    seconds: float,
    beside: AllEstimates | None = None,
    advice: Recommendation | None = None,
) -> dict[str, Any]:
    """Return parameters and errors of a fit, and beside it other estimators, their agreement, and other deviations."""
    found: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "parameters": _parameters(every_parameter(fit)),
        "error": {"train": _before_after(train), "validation": _before_after(validation)},
        "seconds": seconds,
        "criteria": None if fit.criteria is None else _criteria(fit.criteria),
        "correlations": {"names": list(fit.information.names), "matrix": fit.correlations().matrix.tolist()},
    }
    if advice is not None:
        found["recommended"] = _recommended(advice)
    if beside is None:
        return cleaned(found)
    predicted, agreed, spread = beside.predicted, beside.agreed, beside.spread
    found["closed_form"] = {
        name: {"value": e.value, "std": e.std, "unit": e.unit} for name, e in beside.closed.estimates.items()
    }
    if predicted is not None:
        found["prediction_error"] = {
            "parameters": _parameters(predicted.parameters),
            "force_noise": predicted.force_noise,
            "torque_noise": predicted.torque_noise,
            "criteria": _criteria(predicted.criteria),
        }
    if agreed is not None:
        pairs = [
            {
                "between": list(pair.labels),
                "p_value": pair.p_value,
                "parameters": {
                    name: {"difference": d, "std": s, "p_value": p}
                    for name, d, s, p in zip(agreed.names, pair.difference, pair.std, pair.p_values, strict=True)
                    if np.isfinite(d)
                },
            }
            for pair in agreed.pairs
        ]
        found["agreement"] = {"verdict": agreed.verdict, "pairs": pairs}
    if spread is not None:
        found["std"] = {kind: spread.std(kind) for kind in ("plain", "sandwich", "clustered")}
    return cleaned(found)


def comparison_rows(comparison: Comparison) -> list[dict[str, Any]]:
    """Return the error of every channel of every experiment, worst first."""
    return cleaned(
        [
            {
                "model": compared.label,
                "experiment": t.experiment,
                "channel": t.channel,
                "fit_percent": t.fit_percent,
                "rms": t.rms,
                "rms_over_noise": t.rms / t.noise,
                "whiteness_p": t.whiteness_p,
                "correlations": _correlations(t),
            }
            for compared in comparison.models
            for t in compared.worst(len(compared.traces))
        ]
    )


def _consequence(diagnosis: Diagnosis) -> dict[str, Any] | None:
    """Return what the named or the detectable effects take off the error, as fractions."""
    if diagnosis.consequence is None:
        return None
    return {
        "predicted": diagnosis.consequence.predicted,
        "simulated": diagnosis.consequence.simulated,
        "detectable": [c.id for c in diagnosis.detectable],
    }


def _criteria(found: InformationCriteria) -> dict[str, Any]:
    return {"aic": found.aic, "bic": found.bic, "fpe": found.fpe, "unknowns": found.unknowns, "samples": found.samples}


def _correlations(trace: Trace) -> dict[str, Any]:
    """Return the residual's correlations with itself and with the input, with their 99 % bands; lags in samples."""
    own, band = trace.autocorrelation(LAGS)
    found: dict[str, Any] = {"autocorrelation": own.tolist(), "autocorrelation_band": band}
    if np.any(trace.current):
        cross = trace.input_correlation(LAGS)
        found |= {"lags": cross.lags.tolist(), "with_input": cross.values.tolist(), "with_input_band": cross.band}
    return found


def _effect(candidate: Candidate, known: Mapping[str, Parameter]) -> dict[str, Any]:
    """Return an effect at the parameters of the last fit where there is one, else at those of the diagnosis."""
    parameters = {n: known.get(f"{candidate.id}.{n}", found) for n, found in candidate.parameters.items()}
    return {
        "id": candidate.id,
        "score": candidate.score,
        "p_value": candidate.p_value,
        "error_reduction": candidate.error_reduction,
        "confusable_with": list(candidate.confusable_with),
        "parameters": _parameters(parameters),
    }


def _candidate(c: Candidate, accepted: bool) -> dict[str, Any]:
    return {
        "id": c.id,
        "p_value": c.p_value,
        "detection_limit": c.detection_limit,
        "testable": c.testable,
        "score": c.score,
        "unit": c.unit,
        "refitted": c.refitted,
        "bic_gain": c.bic_gain if c.refitted else None,
        "error_reduction": c.error_reduction if c.refitted else None,
        "accepted": accepted,
    }


def _parameters(parameters: Mapping[str, Parameter]) -> dict[str, Any]:
    return {name: {"value": p.value, "std": p.std, "unit": p.unit} for name, p in parameters.items()}


def _recommended(advice: Recommendation) -> dict[str, Any]:
    """Return which estimates to use, and what their deviations take for granted."""
    return {
        "estimator": advice.estimator,
        "std_for": advice.deviation,
        "sound": advice.sound,
        "parameters": _parameters(advice.parameters),
    }


def _before_after(comparison: Comparison | None) -> dict[str, Any] | None:
    """Return the errors of the first model and of the last, which is the same where nothing was added.

    None where nothing was held out.
    """
    if comparison is None:
        return None
    return {"before": _errors(comparison.models[0]), "after": _errors(comparison.models[-1])}


def _errors(compared: Compared) -> dict[str, Any]:
    return {channel: dataclasses.asdict(error) for channel, error in compared.errors.items()}
