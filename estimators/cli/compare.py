"""`rtac compare`: one model, or several, against measurement."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from estimators.cli.captions import shown
from estimators.cli.job import Job, job
from estimators.cli.models import recommended_fit, seen
from estimators.cli.options import Effects, File, Json, Out, Validation
from estimators.cli.refusals import WRONG_USE, stop
from estimators.cli.report_page import write_json, write_report
from estimators.validation.trace import colour_of

if TYPE_CHECKING:
    from estimators.validation.simulation_error import Compared, Comparison

Models = Annotated[
    list[Path] | None,
    typer.Option(
        "--model",
        metavar="FILE.h5",
        help="A saved model or fit to judge instead of the paper's; give it again for each of several.",
        show_default=False,
    ),
]


def compare(
    file: File,
    validation: Validation = None,
    models: Models = None,
    effects: Effects = None,
    ahead: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="SAMPLES",
            help="Predict so many samples ahead instead of simulating; a model or a fit by simulation takes the noise that these "
            "data make likeliest, held-out ones too.",
        ),
    ] = None,
    out: Out = None,
    json: Json = None,
) -> None:
    """Compare model and measurements by channel and experiment, test the residuals, and show where the model fails."""
    with job(file, validation, out, json) as work:
        from estimators.reporting import report as _report
        from estimators.reporting import summary
        from estimators.reporting import tables as _tables
        from estimators.reporting.several_models import models_dict, models_table

        fits, labels = _judged(work, models, effects)
        trained, tested = work.compared(fits, labels, ahead=ahead)
        against = tested or trained
        rows = _report.comparison_rows(against)
        tables = []
        for compared in against.models:
            own = [row for row in rows if row["model"] == compared.label]
            table = _tables.comparison_table(own, whiteness=not against.several_ahead)
            tables += [compared.label] * (len(fits) > 1) + [table]
        errors = _tables.error_table(trained, tested) if len(fits) == 1 else models_table(trained, tested)
        where = "\n".join(_where(compared, rows, against, several=len(fits) > 1) for compared in against.models)
        if ahead is not None:
            where = f"{against.several_ahead or 'Predictions one sample ahead.'}\n{where}"
        criteria = [
            f"{fit.criteria}, of the fit {label}"
            for label, fit in zip(labels, fits, strict=True)
            if hasattr(fit, "criteria")
        ]
        work.say(work.remark, *tables, where, *criteria, errors)
        if models is None:
            content = _report.fit_dict(fits[0], train=trained, validation=tested, seconds=work.seconds)
        else:
            content = models_dict(fits, trained, tested, seconds=work.seconds)
        write_json(work, {**content, "experiments": rows})
        if work.folder is not None:
            from estimators.plots import plot_comparison, plot_residuals

            figures, captions = {"comparison": plot_comparison(against)}, {"comparison": work.held}
            for number, compared in enumerate(against.models, 1):
                name, whose = (f"residuals_{number}", f" of {compared.label}") if len(fits) > 1 else ("residuals", "")
                figures[name] = plot_residuals(compared)
                captions[name] = f"Residual tests{whose}, of the worst experiment."
            parameters = [
                block
                for label, fit in zip(labels, fits, strict=True)
                for block in ([label] * (len(fits) > 1) + [_parameters(fit)])
            ]
            sections = [
                ("Result", [where, work.remark, errors, *criteria]),
                ("Figures", shown(figures, **captions)),
                ("Every experiment", tables),
                ("Parameters", parameters),
            ]
            bullets = summary.of_comparison(trained, tested, file=work.file)
            write_report(work, f"Comparison with {work.file}", figures, sections, summary=bullets, traces=against)


def _judged(work: Job, models: list[Path] | None, effects: Path | None) -> tuple[list[Any], list[str]]:
    """Return fits or models and their labels; the paper's model, fitted to the training part, where none was named."""
    if not models:
        return [work.fitted(work.model())], ["model"]
    work.model()  # so that a recording that no model suits is refused as ever
    labels = [path.stem for path in models]
    if len(set(labels)) < len(labels):
        labels = [str(path) for path in models]
    if len(set(labels)) < len(labels):
        stop(WRONG_USE, "--model: names a file twice; give each once.")
    fits = [recommended_fit(path, effects) for path in models]
    if work.held_out is not None:
        for label, fit in zip(labels, fits, strict=True):
            if known := seen(fit, work.held_out):
                work.note(
                    f"{label} was fitted to {', '.join(known)}, which are held out here, so its error there is too good."
                )
    return fits, labels


def _where(compared: "Compared", rows: list[dict[str, Any]], against: "Comparison", *, several: bool) -> str:
    own = [row for row in rows if row["model"] == compared.label]
    worst = compared.worst(1)[0]
    white = sum(colour_of(row["whiteness_p"]) == "white" for row in own)
    tested = "" if against.several_ahead else f"; {white} of {len(own)} residuals are white"
    return (
        f"{compared.label if several else 'The model'} fails most in {worst.channel} of {worst.experiment}, by "
        f"{worst.rms / worst.noise:.2f} times the noise{tested}."
    )


def _parameters(fit: Any) -> Any:
    """Return a table of the parameters; of a model without deviations."""
    from estimators.reporting.html import Table
    from estimators.reporting.tables import parameter_table

    if hasattr(fit, "information"):
        return parameter_table(fit)
    shown = fit.overview()
    return Table(tuple(shown.header), tuple(tuple(row) for row in shown.rows))
