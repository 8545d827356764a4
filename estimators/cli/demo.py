"""`rtac demo`: the whole loop on a recording with a hidden effect."""

import time
from pathlib import Path
from typing import Annotated

import typer

from estimators.cli.improve import improved
from estimators.cli.job import Job, prepare, printed_last
from estimators.cli.options import Json
from estimators.cli.output_files import writable_folder
from estimators.cli.refusals import answering


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
        with printed_last(Job("demo.h5", recording, None, folder, json or folder / "result.json", began)) as work:
            improved(work)
