"""`rtac fit`: parameters by every estimator."""

from typing import TYPE_CHECKING, Annotated, Any

import typer

from estimators.cli.captions import shown
from estimators.cli.job import Job, job
from estimators.cli.models import start_model
from estimators.cli.options import Add, Effects, File, Fix, Json, Model, Out, Save, Validation
from estimators.cli.report_page import write_json, write_report

if TYPE_CHECKING:
    from estimators.closed_form.table1 import ClosedForm
    from estimators.core.fit import Fit

# For each 100,000 samples, as measured with an arm that is free and sampled at 2 ms; output error's with what compiling takes.
_MINUTES = 3.0
_COMPILING, _SECONDS = 10.0, 5.0
_SLOWLY = (
    "rtac: {samples:,} samples in long experiments: output error takes some {seconds:.0f} s, random forces and the comparison of "
    "the estimates some {minutes:.2g} minutes; a part of it is answered sooner (Experiment.cut)."
)

# Where that would be some ten minutes.
_TOO_LONG = 300_000
_BESIDE = 180.0  # s that the prediction error and the comparison are given: of a model that follows nothing they take for ever
_NOT_IN_TIME = (
    "No {what} within {seconds:.0f} s, as where a model follows nothing; est.prediction_error_nonlinear and est.agreement go on to"
    " their end."
)
_LEFT_OUT = (
    "No prediction error and no comparison of the estimates, which of {samples:,} samples would take some "
    "{minutes:.0f} minutes: fit a part of it (Experiment.cut), or call est.prediction_error_nonlinear and est.agreement. Output "
    "error alone takes some {seconds:.0f} s."
)


def fit(
    file: File,
    validation: Validation = None,
    robust: Annotated[
        bool, typer.Option("--robust", help="Let spikes and dropouts count for little in output error, and list them.")
    ] = False,
    model: Model = None,
    fix: Fix = None,
    add: Add = None,
    effects: Effects = None,
    save: Save = None,
    out: Out = None,
    json: Json = None,
) -> None:
    """Fit by closed form, output error and prediction error side by side, with standard deviations, and test their agreement.

    What is saved is the fit that is recommended.
    """
    with job(file, validation, out, json, save) as work:
        import estimators as est
        from estimators.core.piecewise_triangle import LONG
        from estimators.reporting import report as _report
        from estimators.reporting import summary
        from estimators.reporting import tables as _tables
        from estimators.reporting.fit_table import AllEstimates, estimates_table, fit_table, recommended_table
        from estimators.validation.differing_experiments import differing

        start = start_model(work, model, effects, fix, add)
        closed = est.least_squares(start, work.train, weak=True)
        if closed.reversed_drive:
            work.note(closed.reversed_drive)
        total = sum(e.samples for e in work.train if e.kind != "rest")
        fraction = total / 1e5
        times = {"samples": total, "minutes": _MINUTES * fraction, "seconds": _COMPILING + _SECONDS * fraction}
        if total >= _TOO_LONG:
            work.note(_LEFT_OUT.format(**times))
            typer.echo(f"rtac: {_LEFT_OUT.format(**times)}", err=True)
        elif max(e.samples for e in work.train) >= LONG:
            typer.echo(_SLOWLY.format(**times), err=True)
        found = work.fitted(start, from_model=model is not None, robust=robust)
        predicted, agreed = None, None
        if total < _TOO_LONG:
            predicted, agreed = _side_by_side(work, closed, found)
        spread = work.spread(found)
        if (differences := differing(found, work.train)) is not None:
            work.note(differences.differences)
        trained, tested = work.compared(found)
        errors = _tables.error_table(trained, tested)
        both_move = any(e.arm == "free" and e.cart == "free" for e in work.train if e.kind != "rest")
        known = AllEstimates(closed, found, predicted, agreed, spread, both_move)
        table = fit_table(known)
        advice = est.recommended(found, trained.models[0], predicted=predicted, spread=spread)
        first = recommended_table(advice, found)
        criteria = f"{found.criteria} of output error" + (
            f"\n{predicted.criteria} of prediction error" if predicted else ""
        )
        discounted = _discounted(found) if robust else ""
        work.say(work.remark, f"{first}\n{advice.sentence}", table, criteria, found.outcome, discounted, errors)
        work.save(predicted if predicted is not None and advice.estimator == "prediction error" else found, save)
        content = _report.fit_dict(
            found, train=trained, validation=tested, seconds=work.seconds, beside=known, advice=advice
        )
        listed = [{**vars(one), "samples": list(one.samples)} for one in found.discounted]
        write_json(work, {**content, "concerns": work.doubts or [], "discounted": listed})
        if work.folder is not None:
            from estimators.plots import plot_comparison, plot_correlations, plot_recording, plot_residuals

            figures = {
                "comparison": plot_comparison(tested or trained),
                "residuals": plot_residuals(trained.models[0]),
                "correlations": plot_correlations(found.correlations()),
                "recording": plot_recording(work.recording),
            }
            captions = {"comparison": work.held, "residuals": "Residual tests of the worst of the fitted experiments."}
            captions |= {"correlations": "Ellipses of two standard deviations, and correlations, of output error."}
            captions |= {"recording": "The recording."}
            if agreed is not None:
                figures = {"agreement": agreed.plot(), **figures}
                captions = {
                    "agreement": "Estimates by every estimator, with what chance allows between them.",
                    **captions,
                }
            skipped = [f"The closed form could not use {name}: {why}" for name, why in closed.skipped.items()]
            agreement = "" if agreed is None else agreed.verdict
            sections = [
                ("Result", [work.remark, agreement, found.outcome, discounted, *skipped, criteria, errors]),
                ("Parameters", [first, estimates_table(known)]),
                ("Figures", shown(figures, **captions)),
            ]
            bullets = summary.of_fit(found, advice, trained, tested, file=work.file)
            write_report(work, f"Fit of {work.file}", figures, sections, summary=bullets, traces=tested or trained)


def _side_by_side(work: Job, closed: "ClosedForm", found: "Fit") -> tuple[Any, Any]:
    """Return the fit by predictions one sample ahead, and how far the estimators agree; None, with a note, where there is none."""
    import numpy as np

    import estimators as est
    from estimators.core.deadline import Deadline, OutOfTimeError
    from estimators.core.piecewise_triangle import LONG

    predicted, agreed = None, None
    longer = max(e.samples for e in work.train) / LONG
    deadline = Deadline(_BESIDE * max(1.0, longer))
    with deadline.kept():
        try:
            predicted = est.prediction_error_nonlinear(found.model, work.train, from_model=not found.lost)
        except (ValueError, est.DivergedError) as error:  # such as data that leave parameters free beside random forces
            work.note(f"No prediction error: {error}")
        except OutOfTimeError:
            work.note(_NOT_IN_TIME.format(what="prediction error", seconds=deadline.seconds))
        try:
            estimates = [closed, found] if predicted is None else [closed, found, predicted]
            agreed = est.agreement(estimates, work.train)
        except np.linalg.LinAlgError:
            work.note("The estimators were not compared: the recording leaves something undetermined for one of them.")
        except ValueError as error:  # the closed form needs channels that the fit does not
            work.note(f"The estimators were not compared: {error}")
        except OutOfTimeError:
            work.note(_NOT_IN_TIME.format(what="comparison of the estimators", seconds=deadline.seconds))
    return predicted, agreed


def _discounted(found: "Fit") -> str:
    """Say which samples a robust fit discounts."""
    if not found.discounted:
        return "The robust fit discounts no sample."
    return "\n".join(["The robust fit discounts these samples:", *(f"- {one}" for one in found.discounted)])
