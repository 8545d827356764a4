"""`rtac next-experiment`: the experiment that would tell apart what the data leave open."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from estimators.cli.captions import shown
from estimators.cli.job import Job, job
from estimators.cli.limits import TorqueLimit, Travel, positive
from estimators.cli.models import base_fit, loaded, with_article
from estimators.cli.options import Effects, File, Json, Model, Out, Quick, Validation, option
from estimators.cli.output_files import writable_file
from estimators.cli.own_effects import offered
from estimators.cli.refusals import WRONG_USE, stop
from estimators.cli.report_page import write_json, write_report

if TYPE_CHECKING:
    from estimators.core.fit import Fit
    from rtac_jax.effects import Effect

_PLAYED = (".csv", ".h5", ".hdf5")


def next_experiment(
    file: File,
    play: Annotated[
        Path | None,
        option("FILE.csv|.h5", "Write the recommended experiment for the rig to play."),
    ] = None,
    between: Annotated[
        str | None,
        option(
            "ID,...",
            "Effects to tell apart, or one to be told from nothing; by default those that the diagnosis leaves open.",
        ),
    ] = None,
    travel: Travel = 15.0,
    torque_limit: TorqueLimit = 0.1,
    speed_limit: Annotated[float, typer.Option(metavar="RAD/S", help="Of the arm.")] = 55.0,
    current_limit: Annotated[
        float | None, option("A", "Of the amplifier; by default the torque alone limits it.")
    ] = None,
    duration: Annotated[
        float | None,
        option("S", "Of the experiment; by default as the longest of the recording."),
    ] = None,
    diagnosis: Annotated[
        Path | None,
        option("FILE.h5", "A diagnosis that was kept (--save); without one it is made."),
    ] = None,
    validation: Validation = None,
    quick: Quick = False,
    model: Model = None,
    effects: Effects = None,
    out: Out = None,
    json: Json = None,
) -> None:
    """Plan the experiment that best tells apart the effects between which a diagnosis could not decide."""
    limited = {"--travel": travel, "--torque-limit": torque_limit, "--speed-limit": speed_limit}
    positive(limited | ({} if current_limit is None else {"--current-limit": current_limit}))
    if play is not None and play.suffix.lower() not in _PLAYED:
        stop(WRONG_USE, f"--play: is {play}; let the name end in {', '.join(_PLAYED)}.")
    if play is not None:
        writable_file(play, "--play", written=_PLAYED)
    with job(file, validation, out, json) as work:
        import estimators as est
        from estimators.reporting.html import cleaned
        from estimators.reporting.report import FORMAT, VERSION
        from estimators.reporting.summary import of_next_experiment

        candidates = offered(effects)
        base = base_fit(work, model, effects)
        found = _found(work, base, diagnosis, effects, candidates, quick)
        planned = est.next_experiment(
            base, work.train, found, between=None if between is None else [name.strip() for name in between.split(",")],
            candidates=candidates, travel=1e-3 * travel, torque_limit=torque_limit, speed_limit=speed_limit,
            current_limit=current_limit, duration=duration, held_out=work.held_out,
        )  # fmt: skip
        if play is not None:
            planned.save(play)
        limits = (
            f"travel {travel:g} mm (--travel), torque {torque_limit:g} N m (--torque-limit), arm {speed_limit:g} rad/s "
            f"(--speed-limit), current {'as the torque allows' if current_limit is None else f'{current_limit:g} A'}"
        )
        how = f"Within these limits of the rig: {limits} (--current-limit)." + (
            f"\nto be played: {play}" if play else ""
        )
        work.say(found.overview().title, work.remark, planned, how)
        content = {"format": FORMAT, "version": VERSION, "verdict": found.verdict, "next_experiment": planned.as_dict()}
        write_json(work, cleaned({**content, "seconds": work.seconds}))
        if work.folder is not None:
            figures = {"next_experiment": planned.plot()}
            caption = "How well every experiment within the limits would tell them apart, and the recommended one."
            sections = [
                ("Next experiment", [*str(planned).split("\n\n")[0].splitlines(), work.remark]),
                ("Figures", shown(figures, next_experiment=caption)),
            ]
            bullets = of_next_experiment(planned, file=work.file)
            write_report(work, f"Next experiment after {work.file}", figures, sections, summary=bullets)


def _found(
    work: Job,
    base: "Fit",
    path: Path | None,
    effects: Path | None,
    candidates: "Sequence[type[Effect]] | None",
    quick: bool,
) -> Any:
    """Return the diagnosis of a file, or make one."""
    import estimators as est

    if path is None:
        return est.diagnose(base, work.train, candidates=candidates, thorough=not quick)
    found = loaded(path, effects, "--diagnosis")
    if not isinstance(found, est.Diagnosis):
        stop(
            WRONG_USE,
            f"--diagnosis: {path} holds {with_article(type(found).__name__)}; give what `rtac diagnose --save` kept.",
        )
    return found
