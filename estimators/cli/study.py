"""`rtac study`: Monte Carlo studies from TOML files, which go on where they were ended."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from estimators.cli.job import prepare, say
from estimators.cli.options import option
from estimators.cli.refusals import NOT_POSSIBLE, WRONG_USE, answering, stop

study = typer.Typer(
    help="Monte Carlo studies: how uncertain estimates are, whether what is stated of them is true, and what a diagnosis names.",
    no_args_is_help=True,
)
_DASK = "dask://"
Folder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a study.", show_default=False)]


@study.command()
def run(
    file: Annotated[Path, typer.Argument(metavar="FILE.toml", help="Description of the study.", show_default=False)],
    out: Annotated[
        Path | None,
        option("DIR", "Folder of the results; by default the file's name without .toml."),
    ] = None,
    executor: Annotated[
        str | None,
        option(
            "processes|dask://ADDRESS", "A process for each core, or a dask scheduler; by default all in this process."
        ),
    ] = None,
    repetitions: Annotated[
        int | None, typer.Option(min=1, help="More or fewer repetitions than the file says.", show_default=False)
    ] = None,
    chunk: Annotated[
        int | None, typer.Option(min=1, help="Repetitions computed and kept together.", show_default=False)
    ] = None,
) -> None:
    """Run a study, or go on with it; what is finished is kept whatever ends it."""
    with _answering():
        import dataclasses

        import estimators as est

        spec = est.StudySpec.load(file)
        if repetitions is not None:
            spec = dataclasses.replace(spec, repetitions=repetitions)
        folder = out or _folder_beside(file)
        prepare()
        with _executor(executor) as chosen:
            found = est.study(spec, executor=chosen, out=folder, chunk=chunk)
        say(found, f"report: {found.report(folder)}")


@study.command()
def status(folder: Folder) -> None:
    """Return how much of a study is finished, and how often it failed."""
    with _answering():
        found = _finished(folder)
        say(f"{folder}: {found.spec.name}, {found.ending}")


@study.command()
def show(
    folder: Folder,
    report: Annotated[bool, typer.Option("--report", help="Write figures, CSV files and report.html anew.")] = False,
) -> None:
    """Show what a study has found so far."""
    with _answering():
        found = _finished(folder)
        if not len(found.index):
            stop(NOT_POSSIBLE, f"{folder}: no repetition is finished yet.")
        if report:
            prepare()
        say(found, f"report: {found.report(folder)}" if report else "")


@study.command(name="list")
def list_studies(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where to look.")] = Path("."),
) -> None:
    """List the studies in a folder, and those that are described there and not begun."""
    with _answering():
        import estimators as est
        from estimators.study import SpecError
        from estimators.study.storage import studies_in

        if not folder.is_dir():
            stop(WRONG_USE, f"{folder}: there is no such folder.")
        lines = []
        for place in studies_in(folder):
            try:
                found = _finished(place)
            except ValueError as error:  # one that is damaged hides no other
                lines.append(str(error) if str(place) in str(error) else f"{place}: {error}")
                continue
            lines.append(f"{place}: {found.ending} {found.spec.question}".strip())
        # Those that come with the package stand in a folder of their own.
        for file in sorted([*folder.glob("*.toml"), *folder.glob("studies/*.toml")]):
            try:
                spec = est.StudySpec.load(file)
            except SpecError:
                continue  # some other file
            if file.name != "study.toml":
                lines.append(f"{file}: {spec.repetitions} repetitions. {spec.question}".strip())
        typer.echo("\n".join(lines) if lines else f"{folder}: there is no study here.")


def _folder_beside(file: Path) -> Path:
    """Return the folder here that has the file's name."""
    if not file.stem.strip(". "):
        stop(WRONG_USE, f"{file}: has no name before .toml that a folder could have; name one with --out.")
    return Path(file.stem)


def _finished(folder: Path) -> Any:
    """Return the results that a folder holds."""
    from estimators.study import StudyResults

    return StudyResults.load(folder)


@contextmanager
def _answering() -> Iterator[None]:
    """Answer as every command does; a wrong description or folder is wrong use."""
    from estimators.study import SpecError, StorageError, WorkerError

    with answering():
        try:
            yield
        except (SpecError, StorageError) as error:
            stop(WRONG_USE, str(error))
        except WorkerError as error:
            stop(NOT_POSSIBLE, str(error))


@contextmanager
def _executor(name: str | None) -> Iterator[Any]:
    if name is None or name == "processes":
        yield name
        return
    if not name.startswith(_DASK) or not name.removeprefix(_DASK):
        stop(WRONG_USE, f"--executor: is {name}; use processes or dask://ADDRESS, such as dask://tcp://10.0.0.1:8786.")
    try:
        from distributed import Client  # type: ignore[import-not-found] - of the extra `cluster`
    except ImportError:
        stop(WRONG_USE, "--executor: dask is not installed; install rtac-jax[cluster].")
    address = name.removeprefix(_DASK)
    address = address if "://" in address else f"tcp://{address}"
    try:
        client = Client(address, timeout=10)
    except (OSError, ValueError) as error:
        stop(WRONG_USE, f"--executor: no dask scheduler answers at {address} ({type(error).__name__}).")
    with client:
        yield client.get_executor()
