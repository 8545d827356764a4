"""`rtac compare`: model against measurement."""

from estimators.cli.captions import shown
from estimators.cli.job import job, say
from estimators.cli.options import File, Json, Out, Validation


def compare(file: File, validation: Validation = None, out: Out = None, json: Json = None) -> None:
    """Compare model and measurements by channel and experiment, test the residuals, and show where the model fails."""
    with job(file, validation, out, json) as work:
        from estimators.reporting import report as _report

        found = work.fitted(work.model())
        trained, tested = work.compared(found)
        against = tested or trained
        rows = _report.comparison_rows(against)
        table, errors = _report.comparison_table(rows), _report.error_table(trained, tested)
        worst = against.models[0].worst(1)[0]
        white = sum(row["whiteness_p"] > 0.01 for row in rows)
        where = (
            f"The model fails most in {worst.channel} of {worst.experiment}, by {worst.rms / worst.noise:.2f} times "
            f"the noise; {white} of {len(rows)} residuals are white."
        )
        say(work.remark, table, where, errors)
        content = _report.fit_dict(found, train=trained, validation=tested, seconds=work.seconds)
        work.write_json({**content, "experiments": rows})
        if work.folder is not None:
            from estimators.plots import plot_comparison, plot_residuals

            figures = {"comparison": plot_comparison(against), "residuals": plot_residuals(against.models[0])}
            remark = "Residual tests of the worst experiment."
            sections = [
                ("Result", [where, work.remark, errors]),
                ("Figures", shown(figures, comparison=work.held, residuals=remark)),
                ("Every experiment", [table]),
                ("Parameters", [_report.parameter_table(found)]),
            ]
            work.write_report(f"Comparison with {work.file}", figures, sections)
