"""`rtac diagnose`: what is missing."""

from functools import reduce
from typing import TYPE_CHECKING, Any

from estimators.cli.captions import BANDS, CONFUSION, DIAGNOSIS, WHERE, shown, without_limits
from estimators.cli.doubts import warn
from estimators.cli.job import Job, job
from estimators.cli.models import base_fit
from estimators.cli.options import Effects, File, Json, Model, Out, Quick, Save, Validation, Within
from estimators.cli.own_effects import offered
from estimators.cli.planned import plan_next, show_plan
from estimators.cli.report_page import write_json, write_report
from estimators.cli.waiting import time_for

if TYPE_CHECKING:
    from estimators.core.fit import Fit
    from estimators.diagnosis.diagnosis import Diagnosis


def diagnose(
    file: File,
    validation: Validation = None,
    quick: Quick = False,
    within: Within = None,
    model: Model = None,
    effects: Effects = None,
    save: Save = None,
    out: Out = None,
    json: Json = None,
) -> None:
    """Rank the effects that the paper's model may be missing."""
    with job(file, validation, out, json, save) as work:
        import estimators as est
        from estimators.core.deadline import SEARCHING, Deadline
        from estimators.reporting import report as _report
        from estimators.reporting import tables as _tables
        from estimators.reporting.diagnosis_summary import of_diagnosis

        candidates = offered(effects)
        seconds = time_for(work.train, within)
        warn(work.note_doubts())
        base = base_fit(work, model, effects)
        found = est.diagnose(base, work.train, candidates=candidates, thorough=not quick, within=seconds)
        with Deadline(None if seconds is None else (1 - SEARCHING) * seconds).kept():
            fits, labels = _refitted(work, base, found)
        colour = found.colour_told
        trained, tested = work.compared(fits, labels)
        trained, tested = trained.with_noise(colour), None if tested is None else tested.with_noise(colour)
        table, errors = _tables.candidate_table(found), _tables.error_table(trained, tested)
        planned = None if found.broken_off else plan_next(work, base, found, candidates)
        work.save(found, save)
        table_of_tests = _tables.evidence_table(found)
        work.say(
            *work.ordered(found.verdict, found.explanation),
            table,
            table_of_tests,
            errors,
            planned or "",
            found.policy.words,
        )
        write_json(
            work,
            _report.report_dict(
                found, fit=fits[-1], train=trained, validation=tested, planned=planned, seconds=work.seconds
            ),
        )
        if work.folder is not None:
            from estimators.plots import (
                plot_bands,
                plot_comparison,
                plot_confusion,
                plot_diagnosis,
                plot_residuals,
                plot_where,
            )

            figures = {
                "diagnosis": plot_diagnosis(found, recording=work.train),
                "confusion": plot_confusion(found),
                "bands": plot_bands(tested or trained, coloured=found.coloured),
                "comparison": plot_comparison(tested or trained),
                "residuals": plot_residuals(trained.models[0]),
            }
            if found.places:
                figures["where"] = plot_where(found)
            captions = {
                "diagnosis": DIAGNOSIS,
                "where": WHERE,
                "confusion": CONFUSION,
                "bands": f"{BANDS} {work.held}",
                "comparison": work.held,
                "residuals": "What the base model leaves of the worst experiment.",
            }
            show_plan(planned, work, figures, captions)
            sections = [
                (f"Verdict: {found.verdict}", work.ordered(found.verdict, without_limits(found.explanation))),
                ("Error before and after", [errors]),
                ("Figures", shown(figures, **captions)),
                ("Candidates", [table]),
                ("Is anything missing?", [_tables.evidence_table(found), _tables.place_table(found)]),
                ("Parameters", [_tables.parameter_table(fits[-1], base=base if len(fits) > 1 else None)]),
                ("Thresholds", [_tables.policy_table(found.policy)]),
            ]
            bullets = of_diagnosis(found, trained, tested, file=work.file, doubts=work.doubts or ())
            write_report(
                work, f"Diagnosis of {work.file}", figures, sections, summary=bullets, traces=tested or trained
            )


def _refitted(work: Job, base: "Fit", found: "Diagnosis") -> tuple[list[Any], list[str]]:
    """Return the base model and, where effects were added, the fit with them by simulation, with labels.

    What a simulation cannot fit is held at the diagnosis's estimate.
    """
    import estimators as est
    from estimators.core.deadline import OutOfTimeError
    from estimators.diagnosis.held_estimates import counting_held
    from estimators.diagnosis.model_extension import holding
    from rtac_jax import RTAC

    fits, labels = [base], ["base"]
    if found.additions:
        names = ", ".join(effect.id for effect in found.additions)
        free = reduce(RTAC.__add__, found.additions, base.model)
        known = {f"{c.id}.{name}": std for c in found.effects for name, std in c.deviations.items()}
        for extended, held in (
            (free, ""),
            (holding(free, [effect.id for effect in found.additions]), ", held at the estimate of the diagnosis"),
        ):
            try:
                fits.append(counting_held(est.output_error(extended, work.train, from_model=True), work.train, known))
            except (est.NotIdentifiableError, est.DivergedError, FloatingPointError) as error:
                work.note(f"The model with {names}{held} could not be fitted by simulation: {error}")
            except OutOfTimeError:
                work.note(f"The time was over before the model with {names}{held} was fitted by simulation.")
                break
            else:
                labels.append(f"+ {names}{held}")
                if held:
                    work.note(f"The errors after are those with {names}{held}.")
                break
    return fits, labels
