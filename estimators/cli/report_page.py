"""The page of a command's report, beside its figures."""

import datetime
import hashlib
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from estimators.cli.job import Job

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from estimators.reporting.html import Bullets
    from estimators.validation.simulation_error import Comparison


def write_json(work: Job, content: Mapping[str, Any]) -> None:
    """Write the numbers, if a file was named."""
    from estimators.reporting import html as _report_file

    if work.json is not None:
        _report_file.write_json(work.json, content)


def write_report(
    work: Job,
    title: str,
    figures: "Mapping[str, Figure]",
    sections: Sequence[tuple[str, Sequence[Any]]],
    *,
    split: tuple[Sequence[str], Sequence[str]] | None = None,
    summary: "Bullets | None" = None,
    traces: "Comparison | None" = None,
) -> None:
    """Write figures and report.html.

    Args:
        work: the job.
        title: of the page.
        figures: by the names of their files.
        sections: of the page.
        split: names what was fitted and held out, where that is not the job's own.
        summary: three bullets that the page begins with.
        traces: a comparison whose signals the reader can zoom.
    """
    from estimators.reporting import html as _report_file
    from estimators.reporting.trace_viewer import trace_viewer

    assert work.folder is not None
    fitted, apart = split or (work.train.names, work.held_out.names if work.held_out is not None else ())
    settings = _report_file.Table(
        ("setting", "value"),
        (
            ("command", shlex.join(["rtac", *sys.argv[1:]])),
            ("recording", work.file),
            ("SHA-256 of the file", _digest(work.path)),
            ("date", datetime.datetime.now().astimezone().isoformat(sep=" ", timespec="minutes")),
            ("fitted to", ", ".join(fitted)),
            ("held out", ", ".join(apart) or "nothing"),
            ("took", f"{work.seconds:.0f} s"),
        ),
    )
    whole = [(heading, [block for block in blocks if block != ""]) for heading, blocks in sections]
    if summary is not None:
        whole[0][1].insert(0, summary)
    if traces is not None:
        whole.insert(min(2, len(whole)), ("Signals", [trace_viewer(traces)]))
    images = _report_file.write_figures(work.folder, figures)
    whole.append(("Settings and versions", [settings, _report_file.versions()]))
    _report_file.write_report(work.folder / "report.html", title, whole, images=images)
    work.said.append(f"report: {work.folder / 'report.html'}")


def _digest(path: Path | None) -> str:
    """Return the SHA-256 of the file that was read; empty where there is none."""
    if path is None:
        return ""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
