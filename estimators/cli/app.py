"""`rtac`: what a recording says of a rig, from the command line.

Exit status 0: done; 1: the data do not allow it; 2: wrong use or unreadable file; 130: interrupted; 143: asked to stop.
"""

import time
from functools import reduce
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from estimators.cli.control import control, envelope
from estimators.cli.job import (
    NOT_POSSIBLE,
    WRONG_USE,
    Job,
    answering,
    job,
    load,
    prepare,
    progress,
    say,
    show_tracebacks,
    stop,
    writable_folder,
)
from estimators.cli.options import Effects, File, Json, Out, Validation
from estimators.cli.study import study


class _Group(TyperGroup):
    """Takes `--debug` anywhere on the line."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        asked = "--debug" in args
        return super().parse_args(ctx, ["--debug"] * asked + [a for a in args if a != "--debug"])


app = typer.Typer(
    cls=_Group,
    help="Find the physics that a model of a rotational/translational actuator leaves out.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def main() -> None:
    """Run a command; `rtac_entry.main` calls it when signals and pipes are taken care of."""
    app()


def _print_version(wanted: bool) -> bool:
    if wanted:
        from rtac_jax import __version__

        typer.echo(f"rtac-jax {__version__}")
        raise typer.Exit
    return wanted


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and leave.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show where in the code what goes wrong goes wrong.")] = False,
) -> None:
    """Take the options that stand before a command."""
    show_tracebacks(debug)


@app.command()
def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for everything that is written.")] = Path("demo"),
    json: Json = None,
) -> None:
    """Make a recording with a hidden effect, run the whole loop on it, and write a report with figures."""
    began = time.perf_counter()
    with answering():
        folder = writable_folder(out)
        prepare()
        from estimators.cli.demo_recording import demo_recording

        recording = demo_recording()
        recording.save(folder / "demo.h5")
        typer.echo(
            f"{folder / 'demo.h5'}: {len(recording)} experiments on a virtual rig that has more physics than the "
            "paper's model. The loop does not know what.\n"
        )
        _improve(Job("demo.h5", recording, None, folder, json or folder / "result.json", began))


@app.command()
def info(file: File) -> None:
    """Describe what is in a recording, and what looks wrong with it."""
    with answering():
        from rtac_jax.measurement import concerns, describe, guarded_by_digest

        recording = load(file)
        typer.echo(describe(recording))
        typer.echo(f"\n{_GUARDED if guarded_by_digest(file) else _UNGUARDED}")
        found = concerns(recording)
        typer.echo("\nconcerns:" if found else "\nconcerns: none")
        for sentence in found:
            typer.echo(f"- {sentence}")


@app.command()
def fit(file: File, validation: Validation = None, out: Out = None, json: Json = None) -> None:
    """Fit by closed form, output error and prediction error side by side, with standard deviations, and test their agreement."""
    with job(file, validation, out, json) as work:
        import estimators as est
        from estimators.reporting import report as _report
        from estimators.reporting import summary
        from estimators.reporting.fit_table import estimates_table, fit_table, recommended_table

        model = work.model()
        closed = est.least_squares(model, work.train, weak=True)
        found = work.fitted(model)
        predicted, agreed = None, None
        try:
            predicted = est.prediction_error_nonlinear(found.model, work.train, from_model=True, progress=progress())
        except (ValueError, est.DivergedError) as error:  # such as data that leave parameters free beside random forces
            work.remark = f"{work.remark} No prediction error: {error}".strip()
        try:
            ways = [closed, found] if predicted is None else [closed, found, predicted]
            agreed = est.agreement(ways, work.train, progress=progress())
        except ValueError as error:  # the closed form needs channels that the fit does not
            work.remark = f"{work.remark} The ways were not compared: {error}".strip()
        spread = est.covariances(found, work.train)
        trained, tested = work.compared(found)
        errors = _report.error_table(trained, tested)
        starts = f"{found.statistics['agreed']} of {found.statistics['starts']} starts agree."
        ended = f"{est.RESULTS[found.result]} {starts}"
        table = fit_table(closed, found, predicted=predicted, agreed=agreed, spread=spread)
        advice = est.recommended(found, trained.models[0], predicted=predicted, spread=spread)
        first = recommended_table(advice, found)
        said = f"{found.criteria} of output error" + (
            f"\n{predicted.criteria} of prediction error" if predicted else ""
        )
        say(work.remark, f"{first}\n{advice}", table, said, ended, errors)
        beside = {"closed": closed, "predicted": predicted, "agreed": agreed, "spread": spread}
        beside["advice"] = advice
        work.write_json(_report.fit_dict(found, train=trained, validation=tested, seconds=work.seconds, **beside))
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
                captions = {"agreement": "Estimates by every way, with what chance allows between them.", **captions}
            skipped = [f"The closed form could not use {name}: {why}" for name, why in closed.skipped.items()]
            sections = [
                ("Result", [work.remark, "" if agreed is None else agreed.verdict, ended, *skipped, said, errors]),
                (
                    "Parameters",
                    [first, estimates_table(closed, found, predicted=predicted, agreed=agreed, spread=spread)],
                ),
                ("Figures", _shown(figures, **captions)),
            ]
            bullets = summary.of_fit(found, advice, trained, tested, file=work.file)
            work.write_report(f"Fit of {work.file}", figures, sections, summary=bullets, traces=tested or trained)


@app.command()
def compare(
    file: File,
    validation: Validation = None,
    ahead: Annotated[
        int | None, typer.Option(min=1, metavar="SAMPLES", help="Predict so many samples ahead instead of simulating.")
    ] = None,
    out: Out = None,
    json: Json = None,
) -> None:
    """Compare model and measurements by channel and experiment, test the residuals, and show where the model fails."""
    with job(file, validation, out, json) as work:
        from estimators.reporting import report as _report
        from estimators.reporting import summary

        found = work.fitted(work.model())
        trained, tested = work.compared(found, ahead=ahead)
        against = tested or trained
        rows = _report.comparison_rows(against)
        table, errors = _report.comparison_table(rows), _report.error_table(trained, tested)
        worst = against.models[0].worst(1)[0]
        white = sum(row["whiteness_p"] > 0.01 for row in rows)
        where = (
            f"The model fails most in {worst.channel} of {worst.experiment}, by {worst.rms / worst.noise:.2f} times "
            f"the noise; {white} of {len(rows)} residuals are white."
        )
        say(work.remark, table, where, f"{found.criteria}, of the fit", errors)
        content = _report.fit_dict(found, train=trained, validation=tested, seconds=work.seconds)
        work.write_json({**content, "experiments": rows})
        if work.folder is not None:
            from estimators.plots import plot_comparison, plot_residuals

            figures = {"comparison": plot_comparison(against), "residuals": plot_residuals(against.models[0])}
            remark = "Residual tests of the worst experiment."
            sections = [
                ("Result", [where, work.remark, errors]),
                ("Figures", _shown(figures, comparison=work.held, residuals=remark)),
                ("Every experiment", [table]),
                ("Parameters", [_report.parameter_table(found)]),
            ]
            bullets = summary.of_comparison(trained, tested, file=work.file)
            work.write_report(f"Comparison with {work.file}", figures, sections, summary=bullets, traces=against)


@app.command()
def diagnose(
    file: File,
    validation: Validation = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Do not look again, for minutes, where the verdict would be unknown.")
    ] = False,
    effects: Effects = None,
    out: Out = None,
    json: Json = None,
) -> None:
    """Rank the effects that the paper's model may be missing."""
    with job(file, validation, out, json) as work:
        import estimators as est
        from estimators.diagnosis.model_extension import holding
        from estimators.reporting import report as _report
        from estimators.reporting import summary
        from rtac_jax import RTAC

        candidates = _candidates(effects)
        base = work.fitted(work.model())
        found = est.diagnose(base, work.train, candidates=candidates, thorough=not quick, progress=progress())
        fits, labels = [base], ["base"]
        if found.additions:
            names = ", ".join(effect.id for effect in found.additions)
            free = reduce(RTAC.__add__, found.additions, base.model)
            for model, held in (
                (free, ""),
                (holding(free, [effect.id for effect in found.additions]), ", held at the estimate of the diagnosis"),
            ):
                try:
                    fits.append(est.output_error(model, work.train, from_model=True, progress=progress()))
                except (est.NotIdentifiableError, est.DivergedError, FloatingPointError) as error:
                    failed = f"The model with {names}{held} could not be fitted by simulation: {error}"
                    work.remark = f"{work.remark} {failed}".strip()
                else:
                    labels.append(f"+ {names}{held}")
                    if held:
                        work.remark += f" The errors after are those with {names}{held}."
                    break
        trained, tested = work.compared(fits, labels)
        table, errors = _report.candidate_table(found), _report.error_table(trained, tested)
        planned = _planned(work, base, found, candidates)
        say(found.explanation, work.remark, table, _report.evidence_table(found), errors, planned or "")
        work.write_json(
            _report.report_dict(
                found, fit=fits[-1], train=trained, validation=tested, planned=planned, seconds=work.seconds
            )
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
                "where": plot_where(found),
                "confusion": plot_confusion(found),
                "bands": plot_bands(tested or trained),
                "comparison": plot_comparison(tested or trained),
                "residuals": plot_residuals(trained.models[0]),
            }
            captions = {
                "diagnosis": _DIAGNOSIS,
                "where": _WHERE,
                "confusion": _CONFUSION,
                "bands": f"{_BANDS} {work.held}",
                "comparison": work.held,
                "residuals": "What the base model leaves of the worst experiment.",
            }
            _show_planned(planned, work, figures, captions)
            sections = [
                (f"Verdict: {found.verdict}", [_without_limits(found.explanation), work.remark]),
                ("Error before and after", [errors]),
                ("Figures", _shown(figures, **captions)),
                ("Candidates", [table]),
                ("Is anything missing?", [_report.evidence_table(found), _report.place_table(found)]),
                ("Parameters", [_report.parameter_table(fits[-1], base=base if len(fits) > 1 else None)]),
            ]
            bullets = summary.of_diagnosis(found, trained, tested, file=work.file)
            work.write_report(f"Diagnosis of {work.file}", figures, sections, summary=bullets, traces=tested or trained)


@app.command()
def improve(
    file: File, validation: Validation = None, effects: Effects = None, out: Out = None, json: Json = None
) -> None:
    """Add what is missing, fit again, and check on experiments held out, until nothing more is missing."""
    with job(file, validation, out, json) as work:
        _improve(work, effects)


def _candidates(effects: Path | None) -> Any:
    """Return the catalogue with the user's own effects; None for the catalogue alone."""
    from estimators.cli.own_effects import with_own

    try:
        return with_own(effects)
    except ValueError as error:
        stop(WRONG_USE, f"--effects: {error}")


def _improve(work: Job, effects: Path | None = None) -> None:
    import estimators as est
    from estimators.reporting import report as _report
    from estimators.reporting import summary

    if work.held_out is None:
        stop(NOT_POSSIBLE, work.not_split)
    candidates = _candidates(effects)
    model = work.model()
    with work.explaining():
        found = est.improve(
            model, work.recording, validation=work.held_out.names, candidates=candidates, progress=progress()
        )
    errors = _report.error_table(found.train, found.validation)
    parameters = _report.parameter_table(found.final, base=found.base if found.added else None)
    said = [diagnosis.explanation for diagnosis in found.diagnoses]
    told = [_without_limits(text) for text in said]
    open_question = next((d for d in found.diagnoses if d.verdict == "ambiguous"), None)
    planned = None
    if open_question is not None:
        before = found.diagnoses[: found.diagnoses.index(open_question)]
        base = found.fits[sum(len(diagnosis.additions) for diagnosis in before)]
        planned = _planned(work, base, open_question, candidates)
    say(
        *said,
        found.ending,
        work.remark,
        _report.candidate_table(found.diagnoses[0]),
        errors,
        parameters,
        planned or "",
    )
    work.write_json(_report.report_dict(found, planned=planned, seconds=work.seconds))
    if work.folder is None:
        return
    from estimators.plots import (
        plot_bands,
        plot_comparison,
        plot_confusion,
        plot_diagnosis,
        plot_improvement,
        plot_recording,
        plot_residuals,
        plot_where,
    )
    from estimators.plots.improvement import finding

    leaves = "What the {} model leaves of the worst experiment."
    figures: dict[str, Any] = {"improvement": plot_improvement(found)}
    captions = {"improvement": _LADDER}
    for number, diagnosis in enumerate(found.diagnoses, 1):
        figures[f"diagnosis_{number}"] = plot_diagnosis(diagnosis, recording=work.train)
        captions[f"diagnosis_{number}"] = f"Diagnosis {number}. {_DIAGNOSIS}"
    figures["where"], captions["where"] = plot_where(found.diagnoses[0]), f"{_WHERE} First diagnosis."
    figures["confusion"] = plot_confusion(found.diagnoses[0])
    captions["confusion"] = f"{_CONFUSION} First diagnosis."
    figures["bands"], captions["bands"] = plot_bands(found.validation), f"{_BANDS} Held-out experiments."
    figures["comparison"], captions["comparison"] = plot_comparison(found.validation), "Held-out experiments."
    figures["residuals_before"] = plot_residuals(found.train.models[0])
    captions["residuals_before"] = leaves.format("base")
    if found.added:
        figures["residuals_after"] = plot_residuals(found.train.models[-1])
        captions["residuals_after"] = leaves.format("last")
    figures["recording"], captions["recording"] = plot_recording(work.recording), "The recording."
    _show_planned(planned, work, figures, captions)
    tables: list[Any] = []
    for number, diagnosis in enumerate(found.diagnoses, 1):
        tables += [f"Diagnosis {number}: {diagnosis.verdict}.", _report.candidate_table(diagnosis)]
        tables += [_report.evidence_table(diagnosis), _report.place_table(diagnosis)]
    sections = [
        (f"Verdict: {found.verdict}", [f"{finding(found)}.", *told, found.ending, work.remark]),
        ("Error before and after", [errors]),
        ("Figures", _shown(figures, **captions)),
        ("Parameters", [parameters]),
        ("Candidates", tables),
    ]
    bullets = summary.of_diagnosis(found, found.train, found.validation, file=work.file)
    title = f"Improvement of the model with {work.file}"
    work.write_report(title, figures, sections, summary=bullets, traces=found.validation)


def _planned(work: Job, base: Any, found: Any, candidates: Any) -> Any:
    """Plan the experiment that would tell the effects of an ambiguous diagnosis apart.

    None where none is needed or feasible.
    """
    if found.verdict != "ambiguous":
        return None
    import estimators as est

    try:
        return est.next_experiment(base, work.train, found, candidates=candidates, progress=progress())
    except (ValueError, FloatingPointError) as error:
        work.remark = f"{work.remark} No next experiment could be planned: {error}".strip()
        return None


def _show_planned(planned: Any, work: Job, figures: dict[str, Any], captions: dict[str, str]) -> None:
    if planned is None or work.folder is None:
        return
    planned.save(work.folder / "next_experiment.h5")
    figures["next_experiment"] = planned.plot()
    captions["next_experiment"] = "What would tell them apart; next_experiment.h5 can be played on the rig."


app.command()(envelope)
app.command()(control)
app.add_typer(study, name="study")

_GUARDED = "checksums: the file is as it was written."
_UNGUARDED = "checksums: none, so nothing guards the numbers against damage to the file; Recording.load(...).save(...) adds them."
_DIAGNOSIS = (
    "The bars: what every candidate gains on the one-step predictions of the base model, and from which size on it would "
    "have been found. The curves: the missing force as a function of what it may depend on, with two standard deviations, in "
    "which counts what the model's own parameters could take up, such as a slope. Where the effect that was found is such "
    "a force, its curve is drawn over it."
)
_CONFUSION = (
    "How much alike the changes are that two effects would make in these data: from 0.9 on it takes another kind of "
    "experiment to tell them apart."
)
_WHERE = (
    "Mean squared innovations of the base model in each part of the data, 1 where there is only noise. The darker, the further "
    "beyond what chance exceeds in one of a hundred; these are bold."
)
_BANDS = "Error of free simulation by frequency, in units of the sensor's noise in the same band."
_LADDER = "Left: error of free simulation in units of the sensor noise. Right: the worst of the experiments held out."


def _without_limits(explanation: str) -> str:
    """Return the explanation as far as the tables of a report do not say it better."""
    before, found, limits = explanation.partition(" An effect would have been found from: ")
    rest = limits.partition(". ")[2]
    table = " The table of candidates says from which size on each effect would have been found." if found else ""
    return f"{before}{table}{' ' if rest else ''}{rest}"


def _shown(figures: dict[str, Any], **captions: str) -> list[Any]:
    """Return figures with their captions, in the order of the captions."""
    from estimators.reporting.html import Shown

    return [Shown(figures[name], caption) for name, caption in captions.items()]


if __name__ == "__main__":
    main()
