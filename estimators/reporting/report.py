"""Results as dictionaries for JSON and as tables."""

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from estimators.core.correlation import LAGS
from estimators.core.fit import Fit, Parameter
from estimators.core.information_criteria import InformationCriteria
from estimators.diagnosis.candidate import Candidate
from estimators.diagnosis.diagnosis import Diagnosis
from estimators.diagnosis.improve import Improvement
from estimators.diagnosis.policy import DiagnosisPolicy
from estimators.diagnosis.ranking import ranked
from estimators.experiment_design.next_experiment import NextExperiment
from estimators.reporting.fit_table import AllEstimates
from estimators.reporting.html import Table, cleaned
from estimators.validation.recommendation import Recommendation
from estimators.validation.simulation_error import Compared, Comparison, Trace
from estimators.validation.trace import colour_of
from rtac_jax.measurement import OUTPUTS

FORMAT, VERSION = "rtac-report", 1

# -- dictionaries ----------------------------------------------------------------------------------------------------


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
        known = _every(found.final)
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
            "parameters": _parameters(_every(fit)) if fit is not None else {},
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
        "parameters": _parameters(_every(fit)),
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


def _every(fit: Fit) -> dict[str, Parameter]:
    """Return the shared parameters, and those that each experiment has for itself as NAME[EXPERIMENT].

    The latter have no deviation.
    """
    found = dict(fit.parameters)
    for name in sorted(fit.model.per_experiment):
        unit = fit.model.parameters[name].unit
        values = np.broadcast_to(np.asarray(fit.model[name]), (len(fit.experiments),))
        for experiment, value in zip(fit.experiments, values, strict=True):
            found[f"{name}[{experiment}]"] = Parameter(float(value), math.nan, unit)
    return found


def _before_after(comparison: Comparison | None) -> dict[str, Any] | None:
    """Return the errors of the first model and of the last, which is the same where nothing was added.

    None where nothing was held out.
    """
    if comparison is None:
        return None
    return {"before": _errors(comparison.models[0]), "after": _errors(comparison.models[-1])}


def _errors(compared: Compared) -> dict[str, Any]:
    return {channel: dataclasses.asdict(error) for channel, error in compared.errors.items()}


# -- tables ----------------------------------------------------------------------------------------------------------


def error_table(train: Comparison, validation: Comparison | None) -> Table:
    """Return a table of the error of every channel before and after, for both sides of the split."""
    rows = []
    two = len(train.models) > 1
    for which, comparison in (("train", train), ("validation", validation)):
        if comparison is None:
            continue
        before, after = comparison.models[0].errors, comparison.models[-1].errors
        for channel, error in before.items():
            row = [
                which,
                f"{channel} [{OUTPUTS[channel]}]",
                f"{error.fit_percent:.2f}",
                f"{error.rms:.3g}",
                f"{error.rms_over_noise:.2f}",
            ]
            if two:
                then = after[channel]
                row += [f"{then.fit_percent:.2f}", f"{then.rms:.3g}", f"{then.rms_over_noise:.2f}"]
            rows.append(tuple(row))
    header = ["data", "channel [unit]", "fit [%]", "rms [unit]", "rms/noise [1]"]
    header += ["fit after [%]", "rms after [unit]", "rms/noise after [1]"] if two else []
    what = "free simulation" if train.ahead is None else f"predictions {train.ahead} sample(s) ahead"
    return Table(tuple(header), tuple(rows), f"Error of {what}; the noise is that of the sensor.")


def parameter_table(fit: Fit, *, base: Fit | None = None, estimates: Mapping[str, Parameter] | None = None) -> Table:
    """Return a table of parameters with standard deviations; with a base fit its values before them.

    Args:
        fit: of the last model.
        base: of the first one.
        estimates: parameters with other standard deviations than those for a white residual.
    """
    rows = []
    known, bounds = _every(base) if base is not None else {}, fit.on_bounds()
    idle = {f"{effect.id}.{name}" for effect in fit.model.effects for name in effect.idle}
    for name, p in (_every(fit) | dict(estimates or {})).items():
        if name in idle:
            continue
        std = "" if math.isnan(p.std) else "fixed" if p.is_fixed else f"{p.std:.2g}"
        std += ", on its bound" if name in bounds else ""
        row = [name, f"{p.value:.6g}", std, p.unit]
        if base is not None:
            row.insert(1, f"{known[name].value:.6g}" if name in known else "")
        rows.append(tuple(row))
    header = (
        ("parameter", "before", "value", "std", "unit") if base is not None else ("parameter", "value", "std", "unit")
    )
    return Table(header, tuple(rows))


def comparison_table(rows: Sequence[Mapping[str, Any]], *, whiteness: bool = True) -> Table:
    """Return a table of the error of every channel of every experiment, as `comparison_rows` gives it.

    Args:
        rows: one for each.
        whiteness: show whether each residual is white.
    """
    header = ("experiment", "channel [unit]", "fit [%]", "rms [unit]", "rms/noise [1]", *("residual",) * whiteness)
    return Table(
        header,
        tuple(
            (
                row["experiment"],
                f"{row['channel']} [{OUTPUTS[row['channel']]}]",
                "" if row["fit_percent"] is None else f"{row['fit_percent']:.2f}",
                f"{row['rms']:.3g}",
                f"{row['rms_over_noise']:.2f}",
                *(colour_of(row["whiteness_p"]),) * whiteness,
            )
            for row in rows
        ),
    )


def evidence_table(diagnosis: Diagnosis) -> Table:
    """Return a table of the tests of whether anything is missing, before and after what was added."""
    after = {test.test: test for test in diagnosis.left} if diagnosis.additions else {}
    rows = []
    for test in diagnosis.tests:
        row = [test.test, f"{test.p_value:.2g}", "rejects" if test.rejects else "passes", test.words]
        if diagnosis.additions:
            then = after.get(test.test)
            row[3:3] = [""] if then is None else [f"{'rejects' if then.rejects else 'passes'} (p {then.p_value:.2g})"]
        rows.append(tuple(row))
    header = ["test", "p [1]", "base model", "in words"]
    if diagnosis.additions:
        header.insert(3, "with what was added")
    return Table(
        tuple(header), tuple(rows), "Is anything missing? All tests together reject one right model in a hundred."
    )


def policy_table(policy: DiagnosisPolicy) -> Table:
    """Return a table of the thresholds by which a diagnosis judged."""
    rows = [(name, f"{value:g}", meaning, source) for name, value, meaning, source in policy.rows()]
    return Table(("threshold", "value", "meaning", "source"), tuple(rows), policy.words)


def place_table(diagnosis: Diagnosis, most: int = 8) -> Table:
    """Return a table of the parts of the data where the innovations of the base model are too large."""
    rows = [
        (p.by, p.label, p.channel, f"{p.value:.2f}", f"{p.high:.2f}") for p in diagnosis.places[:most] if p.excess > 1
    ]
    header = ("by", "part", "channel", "mean square / noise variance [1]", "99 % bound [1]")
    return Table(header, tuple(rows), "Squared innovations where they exceed what chance allows, worst first.")


def _fate(named: bool, kept: bool) -> str:
    if named:
        return "accepted" if kept else "not kept"
    return "added later" if kept else ""


def candidate_table(diagnosis: Diagnosis, added: Collection[str] | None = None) -> Table:
    """Return a table of all candidates: what was accepted, then the others by their score.

    Args:
        diagnosis: that tried them.
        added: ids of what a loop added in the end; by default what the diagnosis names is accepted.
    """
    named = {c.id for c in diagnosis.effects}
    kept = named if added is None else set(added)
    rows = []
    for c in ranked(diagnosis):
        rows.append(
            (
                c.id,
                f"{c.score:.1f}",
                f"{c.p_value:.2g}",
                f"{c.bic_gain:.1f}" if c.refitted else "",
                f"{100 * c.error_reduction:.0f}" if c.refitted else "",
                c.limit_or_why,
                _fate(c.id in named, c.id in kept),
            )
        )
    header = ("effect", "score [1]", "p [1]", "BIC gain [1]", "explains [%]", "would be found from", "")
    return Table(
        header,
        tuple(rows),
        "Score: chi-square gained on the one-step predictions, less the price of the parameters. Those that came nearest were "
        "fitted, which gives BIC gain and fraction of the misfit.",
    )
