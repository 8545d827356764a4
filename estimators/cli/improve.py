"""`rtac improve`: the loop."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

from estimators.cli.captions import BANDS, CONFUSION, DIAGNOSIS, LADDER, LEARNED, WHERE, shown, without_limits
from estimators.cli.doubts import explaining, warn
from estimators.cli.job import Job, job
from estimators.cli.models import start_model
from estimators.cli.options import (
    Add,
    Effects,
    File,
    Fix,
    Json,
    Model,
    NoLearnedForce,
    Out,
    Quick,
    Save,
    Validation,
    Within,
)
from estimators.cli.own_effects import offered
from estimators.cli.planned import plan_next, show_plan
from estimators.cli.refusals import NOT_POSSIBLE, stop
from estimators.cli.report_page import write_json, write_report
from estimators.cli.waiting import time_for

if TYPE_CHECKING:
    from estimators.diagnosis.improvement import Improvement


def improve(
    file: File,
    validation: Validation = None,
    quick: Quick = False,
    within: Within = None,
    no_learned_force: NoLearnedForce = False,
    model: Model = None,
    fix: Fix = None,
    add: Add = None,
    effects: Effects = None,
    save: Save = None,
    out: Out = None,
    json: Json = None,
) -> None:
    """Add what is missing, fit again, and check on experiments held out, until nothing more is missing."""
    with job(file, validation, out, json, save) as work:
        improved(
            work,
            effects,
            quick=quick,
            learned_force=not no_learned_force,
            within=within,
            model=model,
            fix=fix,
            add=add,
            save=save,
        )


def improved(
    work: Job,
    effects: Path | None = None,
    *,
    quick: bool = False,
    learned_force: bool = True,
    within: float | None = 0.0,
    model: Path | None = None,
    fix: str | None = None,
    add: str | None = None,
    save: Path | None = None,
) -> None:
    """Run the loop on a job, and say and write what it found."""
    import estimators as est
    from estimators.reporting import report as _report
    from estimators.reporting import tables as _tables
    from estimators.reporting.diagnosis_summary import of_diagnosis
    from estimators.reporting.fit_table import recommended_table

    work.divide()
    if work.held_out is None:
        stop(NOT_POSSIBLE, work.not_split)
    candidates = offered(effects)
    start = start_model(work, model, effects, fix, add)
    warn(work.note_doubts())
    seconds = time_for(work.train, within)
    with explaining(work.recording, work.doubts or []):
        found = est.improve(
            start, work.recording, validation=work.held_out.names, candidates=candidates, thorough=not quick,
            learned_force=learned_force, within=seconds,
        )  # fmt: skip
    extended = len(found.validation.models) > 1
    if found.settled:
        work.withdraw_inconsistencies()
    for comparison in (found.train, found.validation):
        if comparison.divergence:
            work.say(comparison.divergence)
    errors = _tables.error_table(found.train, found.validation)
    advice = _advice(found, work)
    own = advice.parameters if advice is not None and advice.estimator == "output error" else None
    base = found.base if extended else None
    parameters: list[Any] = [_tables.parameter_table(found.final, base=base, estimates=own)]
    if extended and found.base.lost:
        parameters.append(f"Before: {found.base.outcome}")
    if advice is not None:
        parameters += [] if own else [recommended_table(advice, found.final)]
        parameters.append(advice.sentence)
    said = [diagnosis.explanation for diagnosis in found.diagnoses]
    told = [without_limits(text) for text in said]
    # What was not fitted in time is no question for an experiment.
    open_question = next((d for d in found.diagnoses if d.verdict == "ambiguous" and not d.broken_off), None)
    planned = None
    if open_question is not None:
        base = found.fits[found.fitted_before(found.diagnoses.index(open_question))]
        planned = plan_next(work, base, open_question, candidates)
    table, judged = (
        _tables.candidate_table(found.diagnoses[0], [c.id for c in found.added]),
        found.diagnoses[0].policy.words,
    )
    last = found.diagnoses[-1].verdict
    spoken = work.ordered(last, found.headline, *said, found.ending)
    work.say(*spoken, table, errors, *parameters, planned or "", judged)
    work.save(found, save)
    write_json(work, _report.report_dict(found, planned=planned, seconds=work.seconds, advice=advice))
    if work.folder is None:
        return
    from estimators.plots import (
        plot_bands,
        plot_comparison,
        plot_confusion,
        plot_diagnosis,
        plot_improvement,
        plot_learned_force,
        plot_recording,
        plot_residuals,
        plot_where,
    )
    from estimators.plots.improvement import finding

    leaves = "What the {} model leaves of the worst experiment."
    figures: dict[str, Any] = {"improvement": plot_improvement(found)}
    captions = {"improvement": LADDER}
    if found.learned is not None:
        figures["learned_force"], captions["learned_force"] = plot_learned_force(found), LEARNED
    for number, diagnosis in enumerate(found.diagnoses, 1):
        figures[f"diagnosis_{number}"] = plot_diagnosis(diagnosis, recording=work.train)
        captions[f"diagnosis_{number}"] = f"Diagnosis {number}. {DIAGNOSIS}"
    if found.diagnoses[0].places:
        figures["where"], captions["where"] = plot_where(found.diagnoses[0]), f"{WHERE} First diagnosis."
    figures["confusion"] = plot_confusion(found.diagnoses[0])
    captions["confusion"] = f"{CONFUSION} First diagnosis."
    figures["bands"] = plot_bands(found.validation, coloured=found.diagnoses[-1].coloured)
    captions["bands"] = f"{BANDS} Held-out experiments."
    figures["comparison"], captions["comparison"] = plot_comparison(found.validation), "Held-out experiments."
    figures["residuals_before"] = plot_residuals(found.train.models[0])
    captions["residuals_before"] = leaves.format("base")
    if extended:
        figures["residuals_after"] = plot_residuals(found.train.models[-1])
        captions["residuals_after"] = leaves.format("last")
    figures["recording"], captions["recording"] = plot_recording(work.recording), "The recording."
    show_plan(planned, work, figures, captions)
    tables: list[Any] = []
    for number, diagnosis in enumerate(found.diagnoses, 1):
        tables += [
            f"Diagnosis {number}: {diagnosis.verdict}.",
            _tables.candidate_table(diagnosis, [c.id for c in found.added]),
        ]
        tables += [_tables.evidence_table(diagnosis), _tables.place_table(diagnosis)]
    sections = [
        ("Verdict", work.ordered(last, found.headline, f"{finding(found)}.", *told, found.ending)),
        ("Error before and after", [errors]),
        ("Figures", shown(figures, **captions)),
        ("Parameters", parameters),
        ("Candidates", tables),
        ("Thresholds", [_tables.policy_table(found.diagnoses[0].policy)]),
    ]
    estimates = None if advice is None else advice.parameters
    bullets = of_diagnosis(
        found, found.train, found.validation, file=work.file, estimates=estimates, doubts=work.doubts or ()
    )
    title = f"Improvement of the model with {work.file}"
    write_report(work, title, figures, sections, summary=bullets, traces=found.validation)


def _advice(found: "Improvement", work: Job) -> Any:
    """Return which estimates of the last model to use, with which deviations; None where it was fitted by predictions already.

    Predictions are asked where random forces lead its simulation astray.
    """
    import estimators as est
    from estimators.core.fit import FAR
    from estimators.diagnosis.explanation import at_noise

    if found.predicted:
        return None
    predicted = found.by_predictions
    asked = predicted is None and not found.broken_off
    if asked and found.diagnoses[-1].verdict == "adequate" and found.final.farthest > FAR:
        try:
            predicted = est.prediction_error_nonlinear(found.final.model, work.train, from_model=True)
        except (ValueError, est.DivergedError) as error:
            work.note(f"No prediction error: {error}")
    spread = work.spread(found.final)
    advice = est.recommended(found.final, found.train.models[-1], predicted=predicted, spread=spread)
    last = max((e.rms_over_noise for e in found.train.models[-1].errors.values()), default=found.final.farthest)
    adequate = found.diagnoses[-1].verdict == "adequate" and at_noise(last)
    return dataclasses.replace(advice, adequate=adequate, diagnosed=found.diagnosed[-1] == len(found.fits) - 1)
