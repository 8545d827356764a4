"""`rtac`: what a recording says of a rig, from the command line.

Exit status 0: done; 1: the data do not allow it; 2: wrong use or unreadable file; 130: interrupted.
"""

import os
import secrets
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

app = typer.Typer(
    help="Find the physics that a model of a rotational/translational actuator leaves out.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

File = Annotated[Path, typer.Argument(help="Recording (HDF5).", metavar="FILE", show_default=False)]
Validation = Annotated[
    str | None,
    typer.Option(
        metavar="NAME,...",
        help="Experiments to hold out; by default every fourth of each kind.",
        show_default=False,
    ),
]
Out = Annotated[
    Path | None, typer.Option(metavar="DIR", help="Folder for report.html and the figures.", show_default=False)
]
Json = Annotated[Path | None, typer.Option(metavar="FILE", help="Write the result as JSON.", show_default=False)]

NOT_POSSIBLE, WRONG_USE, INTERRUPTED = 1, 2, 130


def main() -> None:
    """Entry point of `rtac`."""
    app()


# -- commands --------------------------------------------------------------------------------------------------------


@app.command()
def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for everything that is written.")] = Path("demo"),
) -> None:
    """Make a recording with a hidden effect, run the whole loop on it, and write a report with figures."""
    with _answering():
        began = time.perf_counter()
        folder = _writable_folder(out)
        _prepare()
        from estimators._demo import demo_recording

        recording = demo_recording()
        recording.save(folder / "demo.h5")
        typer.echo(
            f"{folder / 'demo.h5'}: {len(recording)} experiments on a virtual rig that has more physics than the "
            "paper's model. The loop does not know what.\n"
        )
        _improve(recording, None, folder, folder / "result.json", "demo.h5", began)


@app.command()
def info(file: File) -> None:
    """What is in a recording, and what looks wrong with it."""
    with _answering():
        from rtac_jax.measurement import concerns, describe

        recording = _load(file)
        typer.echo(describe(recording))
        found = concerns(recording)
        typer.echo("\nconcerns:" if found else "\nconcerns: none")
        for sentence in found:
            typer.echo(f"- {sentence}")


@app.command()
def fit(file: File, validation: Validation = None, out: Out = None, json: Json = None) -> None:
    """Closed form and output error side by side, with standard deviations."""
    with _answering():
        began = time.perf_counter()
        folder, json = _targets(out, json)
        recording = _load(file)
        _prepare()
        import estimators as est
        from estimators import _report

        train, held_out, remark = _split(recording, validation)
        model = _model(recording)
        closed = est.least_squares(model, train)
        found = _fitted(recording, model, train)
        trained, tested = _compared(found, train, held_out)
        table = _report.side_by_side(closed, found)
        errors = _report.error_table(trained, tested)
        ended = (
            f"{est.RESULTS[found.result]} {found.statistics['agreed']} of {found.statistics['starts']} starts agree."
        )
        skipped = [f"The closed form could not use {name}: {why}" for name, why in closed.skipped.items()]
        _say(remark, table, ended, *skipped, errors)
        if json is not None:
            seconds = time.perf_counter() - began
            _report.write_json(
                json, _report.fit_dict(found, train=trained, validation=tested, seconds=seconds, closed=closed)
            )
        if folder is not None:
            from estimators.plots import plot_comparison, plot_recording

            figures = {"recording": plot_recording(recording), "comparison": plot_comparison(tested or trained)}
            _write(
                folder, f"Fit of {file.name}", figures, file, train, held_out,
                [
                    ("Result", [remark, ended, *skipped, errors]),
                    ("Parameters", [table]),
                    ("Figures", [
                        _report.Shown(figures["comparison"], _held(tested)),
                        _report.Shown(figures["recording"], "The recording."),
                    ]),
                ], time.perf_counter() - began,
            )  # fmt: skip


@app.command()
def compare(file: File, validation: Validation = None, out: Out = None, json: Json = None) -> None:
    """Fit per channel and experiment, residual tests, and where the model fails."""
    with _answering():
        began = time.perf_counter()
        folder, json = _targets(out, json)
        recording = _load(file)
        _prepare()
        from estimators import _report

        train, held_out, remark = _split(recording, validation)
        found = _fitted(recording, _model(recording), train)
        trained, tested = _compared(found, train, held_out)
        shown = tested or trained
        rows = _report.comparison_rows(shown)
        worst = shown.models[0].worst(1)[0]
        white = sum(row["whiteness_p"] > 0.01 for row in rows)
        where = (
            f"The model fails most in {worst.channel} of {worst.experiment}, by {worst.rms / worst.noise:.2f} times "
            f"the noise; {white} of {len(rows)} residuals are white."
        )
        table = _report.Table(
            ("experiment", "channel", "fit [%]", "rms [SI]", "rms/noise", "residual"),
            tuple(
                (
                    row["experiment"],
                    row["channel"],
                    "" if row["fit_percent"] is None else f"{row['fit_percent']:.2f}",
                    f"{row['rms']:.3g}",
                    f"{row['rms_over_noise']:.2f}",
                    "white" if row["whiteness_p"] > 0.01 else "not white",
                )
                for row in rows
            ),
        )
        errors = _report.error_table(trained, tested)
        _say(remark, table, where, errors)
        if json is not None:
            seconds = time.perf_counter() - began
            content = _report.fit_dict(found, train=trained, validation=tested, seconds=seconds)
            _report.write_json(json, {**content, "experiments": rows})
        if folder is not None:
            from estimators.plots import plot_comparison, plot_residuals

            figures = {"comparison": plot_comparison(shown), "residuals": plot_residuals(shown.models[0])}
            _write(
                folder, f"Comparison with {file.name}", figures, file, train, held_out,
                [
                    ("Result", [where, remark, errors]),
                    ("Figures", [
                        _report.Shown(figures["comparison"], _held(tested)),
                        _report.Shown(figures["residuals"], "Residual tests of the worst experiment."),
                    ]),
                    ("Every experiment", [table]),
                    ("Parameters", [_report.parameter_table(found)]),
                ], time.perf_counter() - began,
            )  # fmt: skip


@app.command()
def diagnose(file: File, validation: Validation = None, out: Out = None, json: Json = None) -> None:
    """Rank the effects that the paper's model may be missing."""
    with _answering():
        began = time.perf_counter()
        folder, json = _targets(out, json)
        recording = _load(file)
        _prepare()
        import estimators as est
        from estimators import _report

        train, held_out, remark = _split(recording, validation)
        base = _fitted(recording, _model(recording), train)
        found = est.diagnose(base, train, progress=_progress())
        fits = [base]
        if found.best is not None:
            try:
                fits.append(est.output_error(base.model + found.best, train, from_model=True, progress=_progress()))
            except (est.NotIdentifiableError, est.DivergedError, FloatingPointError) as error:
                remark = f"{remark} The model with {found.effects[0].id} could not be fitted: {error}".strip()
        labels = ["base", *(f"+ {c.id}" for c in found.effects[:1])][: len(fits)]
        trained, tested = _compared(fits, train, held_out, labels)
        candidates = _report.candidate_table(found)
        errors = _report.error_table(trained, tested)
        _say(found.explanation, remark, candidates, errors)
        if json is not None:
            content = _report.report_dict(
                found, fit=fits[-1], train=trained, validation=tested, seconds=time.perf_counter() - began
            )
            _report.write_json(json, content)
        if folder is not None:
            from estimators.plots import plot_comparison, plot_diagnosis, plot_residuals

            figures = {
                "diagnosis": plot_diagnosis(found),
                "comparison": plot_comparison(tested or trained),
                "residuals": plot_residuals(trained.models[0]),
            }
            _write(
                folder, f"Diagnosis of {file.name}", figures, file, train, held_out,
                [
                    (f"Verdict: {found.verdict}", [found.explanation, remark]),
                    ("Error before and after", [errors]),
                    ("Figures", [
                        _report.Shown(figures["diagnosis"], _DIAGNOSIS),
                        _report.Shown(figures["comparison"], _held(tested)),
                        _report.Shown(figures["residuals"], "What the base model leaves of the worst experiment."),
                    ]),
                    ("Candidates", [candidates]),
                    ("Parameters", [_report.parameter_table(fits[-1], base=base if len(fits) > 1 else None)]),
                ], time.perf_counter() - began,
            )  # fmt: skip


@app.command()
def improve(file: File, validation: Validation = None, out: Out = None, json: Json = None) -> None:
    """Add what is missing, fit again, and check on experiments held out, until nothing more is missing."""
    with _answering():
        began = time.perf_counter()
        folder, json = _targets(out, json)
        recording = _load(file)
        _improve(recording, _names(recording, validation), folder, json, file.name, began)


def _improve(
    recording: Any, names: list[str] | None, folder: Path | None, json: Path | None, title: str, began: float
) -> None:
    from rtac_jax.measurement import RecordingError

    try:
        train, held_out = recording.split(names)
    except RecordingError as error:
        if names is None:
            _stop(NOT_POSSIBLE, str(error))
        raise
    _prepare()
    import estimators as est
    from estimators import _report

    model = _model(recording)
    with _explaining(recording):
        found = est.improve(model, recording, validation=names, progress=_progress())
    errors = _report.error_table(found.train, found.validation)
    parameters = _report.parameter_table(found.final, base=found.base if found.added else None)
    said = [diagnosis.explanation for diagnosis in found.diagnoses]
    _say(*said, found.stopped, _report.candidate_table(found.diagnoses[0]), errors, parameters)
    if json is not None:
        _report.write_json(json, _report.report_dict(found, seconds=time.perf_counter() - began))
    if folder is None:
        return
    from estimators.plots import plot_comparison, plot_diagnosis, plot_improvement, plot_recording, plot_residuals
    from estimators.plots._improvement import finding

    figures: dict[str, Any] = {"improvement": plot_improvement(found)}
    shown = [_report.Shown(figures["improvement"], _LADDER)]
    for number, diagnosis in enumerate(found.diagnoses, 1):
        figures[f"diagnosis_{number}"] = plot_diagnosis(diagnosis)
        shown.append(_report.Shown(figures[f"diagnosis_{number}"], f"Diagnosis {number}. {_DIAGNOSIS}"))
    figures["comparison"] = plot_comparison(found.validation)
    figures["residuals_before"] = plot_residuals(found.train.models[0])
    figures["recording"] = plot_recording(recording)
    shown += [
        _report.Shown(figures["comparison"], "Held-out experiments."),
        _report.Shown(figures["residuals_before"], "What the base model leaves of the worst experiment."),
    ]
    if found.added:
        figures["residuals_after"] = plot_residuals(found.train.models[-1])
        shown.append(_report.Shown(figures["residuals_after"], "What the last model leaves of the worst experiment."))
    shown.append(_report.Shown(figures["recording"], "The recording."))
    tables: list[Any] = []
    for number, diagnosis in enumerate(found.diagnoses, 1):
        tables += [f"Diagnosis {number}: {diagnosis.verdict}.", _report.candidate_table(diagnosis)]
    _write(
        folder, f"Improvement of the model with {title}", figures, title, train, held_out,
        [
            (f"Verdict: {found.verdict}", [f"{finding(found)}.", *said, found.stopped]),
            ("Error before and after", [errors]),
            ("Parameters", [parameters]),
            ("Candidates", tables),
            ("Figures", shown),
        ], time.perf_counter() - began,
    )  # fmt: skip


# -- what the commands share -----------------------------------------------------------------------------------------

_DIAGNOSIS = (
    "Left: what every candidate gains on the one-step predictions of the base model, and from which size on it would "
    "have been found. Right: the missing force as a function of what it may depend on, with two standard deviations."
)
_LADDER = "Left: error of free simulation in units of the sensor noise. Right: the worst of the experiments held out."


def _prepare() -> None:
    """Before anything is computed or drawn."""
    import matplotlib

    import rtac_jax

    matplotlib.use("Agg")
    rtac_jax.configure()


def _progress() -> bool:
    """Bars are for people."""
    return sys.stderr.isatty()


@contextmanager
def _answering() -> Iterator[None]:
    """Turn what may go wrong with data or files into one sentence and an exit status."""
    # Deferred, so that the help comes up without them.
    from estimators._results import DivergedError
    from rtac_jax.measurement import RecordingError

    try:
        yield
    except (RecordingError, OSError) as error:
        _stop(WRONG_USE, _sentence(error))
    except (ValueError, DivergedError, FloatingPointError) as error:
        _stop(NOT_POSSIBLE, _sentence(error))
    except KeyboardInterrupt:
        _stop(INTERRUPTED, "interrupted; nothing that was not complete has been written.")
    except MemoryError:
        _stop(INTERRUPTED, "there is not enough memory for this recording; cut it with Experiment.cut.")


def _sentence(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}."
    return " ".join(str(error).split())


def _stop(status: int, sentence: str) -> NoReturn:
    typer.echo(f"rtac: {sentence}", err=True)
    raise typer.Exit(status)


def _load(file: Path) -> Any:
    from rtac_jax.measurement import Recording

    return Recording.load(file)


def _names(recording: Any, validation: str | None) -> list[str] | None:
    """The experiments named on the command line; a name may hold a comma itself."""
    if validation is None:
        return None
    if validation in recording.names:
        return [validation]
    names = [name.strip() for name in validation.split(",") if name.strip()]
    if not names:
        _stop(WRONG_USE, f"--validation names no experiment; choose among {', '.join(recording.names)}.")
    return names


def _split(recording: Any, validation: str | None) -> tuple[Any, Any, str]:
    """Train, validation or None, and a remark where nothing could be held out."""
    from rtac_jax.measurement import RecordingError

    names = _names(recording, validation)
    try:
        return (*recording.split(names), "")
    except RecordingError as error:
        if names is not None:
            raise
        return recording, None, f"Fitted to all experiments, and nothing validates the result: {error}"


def _model(recording: Any) -> Any:
    from estimators._output_error import moving
    from rtac_jax import RTAC

    moving(recording)
    try:
        return RTAC.from_rig(recording)
    except ValueError as error:
        _stop(WRONG_USE, str(error))


@contextmanager
def _explaining(recording: Any) -> Iterator[None]:
    """Where a fit runs away because nothing fixes the scale, say so."""
    from estimators._results import DivergedError, NotIdentifiableError
    from rtac_jax.measurement import concerns

    try:
        yield
    except DivergedError as error:
        scale = [sentence for sentence in concerns(recording) if sentence.startswith("The scale is not fixed")]
        if scale:
            raise NotIdentifiableError(scale[0]) from error
        raise


def _fitted(recording: Any, model: Any, train: Any) -> Any:
    import estimators as est

    with _explaining(recording):
        return est.output_error(model, train, progress=_progress())


def _compared(fits: Any, train: Any, held_out: Any, labels: Any = None) -> tuple[Any, Any]:
    import estimators as est

    tested = None if held_out is None else est.compare(fits, held_out, labels=labels)
    return est.compare(fits, train, labels=labels), tested


def _held(tested: Any) -> str:
    return "Experiments that were fitted." if tested is None else "Held-out experiments."


def _targets(out: Path | None, json: Path | None) -> tuple[Path | None, Path | None]:
    """The places to write to, tried before anything is computed."""
    folder = None if out is None else _writable_folder(out)
    if json is not None:
        if json.is_dir():
            _stop(WRONG_USE, f"{json}: is a folder; name a file for --json.")
        _writable_folder(json.parent)
    return folder, json


def _writable_folder(folder: Path) -> Path:
    probe = folder / f".{secrets.token_hex(4)}.part"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch(exist_ok=False)
        os.unlink(probe)
    except OSError as error:
        _stop(WRONG_USE, f"{folder}: cannot be written to ({error.strerror}); name another place.")
    return folder


def _say(*blocks: Any) -> None:
    """Paragraphs and tables, an empty line between them."""
    typer.echo("\n\n".join(str(block) for block in blocks if str(block)))


def _write(
    folder: Path,
    title: str,
    figures: dict[str, Any],
    file: Any,
    train: Any,
    held_out: Any,
    sections: list[tuple[str, list[Any]]],
    seconds: float,
) -> None:
    from estimators import _report

    settings = _report.Table(
        ("setting", "value"),
        (
            ("recording", str(file)),
            ("fitted to", ", ".join(train.names)),
            ("held out", ", ".join(held_out.names) if held_out is not None else "nothing"),
            ("took", f"{seconds:.0f} s"),
        ),
    )
    sections = [(heading, [block for block in blocks if block != ""]) for heading, blocks in sections]
    images = _report.write_figures(folder, figures)
    sections.append(("Settings and versions", [settings, _report.versions()]))
    _report.write_report(folder / "report.html", title, sections, images=images)
    typer.echo(f"\nreport: {folder / 'report.html'}")


if __name__ == "__main__":
    main()
