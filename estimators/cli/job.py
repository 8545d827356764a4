"""The frame of every command of `rtac` around its work: read, refuse in one sentence, hold out, write."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from estimators.cli.doubts import doubtful, explaining, unmeasured
from estimators.cli.environment import note_cache, say_once_that_the_cache_is_full
from estimators.cli.output_files import saving_to, writable_file, writable_folder
from estimators.cli.refusals import WRONG_USE, answering, stop

if TYPE_CHECKING:
    from estimators.core.fit import Fit
    from estimators.core.result_base import Result
    from estimators.prediction_error.fit import PredictorFit
    from rtac_jax import RTAC
    from rtac_jax.measurement import Recording


class Job:
    """The run of a command on one recording.

    Attributes:
        file: the recording's path, or the name to show for it.
        recording: all of it.
        train, held_out: what is fitted and what tests the fit; `held_out` is None where nothing can be spared.
        not_split: why not.
        split_said: what is fitted and what is held out, in words.
        notes: what else a reader must know of the result beside it, a sentence each.
        doubts: what contradicts itself in the recording; None before it was looked for.
        inconsistencies: those of them that are held against the equations of motion.
        folder: for the report and the figures, or None.
        json: file for the numbers, or None.
        path: of the file that was read, or None.
    """

    def __init__(
        self,
        file: str,
        recording: "Recording",
        validation: str | None,
        folder: Path | None,
        json: Path | None,
        began: float,
    ) -> None:
        self.file, self.recording, self.folder, self.json, self.began = file, recording, folder, json, began
        self.doubts: list[str] | None = None
        self.inconsistencies: list[str] = []
        self.said: list[Any] = []
        self.path: Path | None = None
        self.names = _names(recording, validation)
        self.train, self.held_out, self.not_split = _split(recording, self.names)
        self.notes: list[str] = []
        self.split_said = (
            f"Fitted to all experiments, and nothing validates the result: {self.not_split}"
            if self.held_out is None
            else f"Held out: {', '.join(self.held_out.names)}."
        )

    def divide(self) -> None:
        """Hold out the last quarter of the only experiment that moves, where nothing else can be spared."""
        divided = self.recording.divided()
        if self.held_out is None and self.names is None and divided is not self.recording:
            self.recording = divided
            self.train, self.held_out, self.not_split = _split(divided, None)
            self.split_said = (
                f"Held out: {', '.join(self.held_out.names)}, the last quarter of the only experiment that moves."
            )

    @property
    def remark(self) -> str:
        """Return what a reader must know of the result beside it, a line for each sentence."""
        return "\n".join([self.split_said, *self.notes]).strip()

    @property
    def seconds(self) -> float:
        """Return seconds since the command began."""
        return time.perf_counter() - self.began

    @property
    def held(self) -> str:
        """Return the caption of a picture of what tests the fit."""
        return "Experiments that were fitted." if self.held_out is None else "Held-out experiments."

    def say(self, *blocks: object) -> None:
        """Print paragraphs and tables, once every file is written."""
        self.said += blocks

    def note(self, sentence: str) -> None:
        """Add a sentence to the remark, on a line of its own."""
        self.notes.append(sentence)

    def model(self) -> Any:
        """Return the paper's model with the constants of the file."""
        from estimators.core.data import moving, pieces
        from estimators.output_error.memory import require_memory
        from rtac_jax import RTAC

        moving(self.recording)
        try:
            model = RTAC.from_rig(self.recording)
        except ValueError as error:
            stop(WRONG_USE, str(error))
        if note := require_memory(model, pieces(moving(self.train))):
            typer.echo(f"rtac: {note}", err=True)
        return model

    def fitted(self, model: "RTAC", *, from_model: bool = False, robust: bool = False) -> Any:
        """Fit the training part by output error; what shows nowhere is held, as what the model lacks may be what would show it.

        Args:
            model: that is fitted.
            from_model: begin at the model's values only, where they are those of a fit.
            robust: let samples far off count for little.
        """
        import estimators as est
        from estimators.output_error.fit_what_shows import fit_what_shows, values_held

        options: dict[str, Any] = {"robust": True} if robust else {}
        with explaining(self.recording, self.note_doubts()):
            fit, held = fit_what_shows(model, self.train, by=est.output_error, from_model=from_model, **options)
        if held:
            where = values_held(fit.model, held, "the model's value")
            self.note(f"{', '.join(held)}: without effect on what is fitted, and held at {where}.")
        return fit

    def spread(self, fit: "Fit") -> Any:
        """Return the covariances of a fit to the training part; None, with a note, where it ended at parameters that are free."""
        import estimators as est
        from estimators.core.results import NotIdentifiableError

        try:
            return est.covariances(fit, self.train)
        except NotIdentifiableError as error:
            self.note(f"No {error}")
            return None

    def note_doubts(self) -> list[str]:
        """Note what contradicts itself or the equations of motion, which a fit would turn into confident numbers, and return it."""
        from estimators.validation.channel_consistency import channel_consistency
        from rtac_jax.measurement import contradictions

        if self.doubts is None:
            self.inconsistencies = channel_consistency(self.recording).concerns
            self.doubts = contradictions(self.recording) + self.inconsistencies
            self.notes += [*unmeasured(self.recording), *map(doubtful, self.doubts)]
        return self.doubts

    def ordered(self, verdict: str, *texts: str) -> list[str]:
        """Return what is said of a verdict, and the remark; that first where a model fails and the recording may be why."""
        if verdict != "unknown" or not self.doubts:
            return [*texts, self.remark]
        first = "The recording contradicts itself or the equations, which may be all that is wrong: mend this first."
        return [first, self.remark, *texts]

    def withdraw_inconsistencies(self) -> None:
        """Take back what the equations of motion alone contradict: a model with what they lack follows the recording."""
        taken_back = set(map(doubtful, self.inconsistencies))
        self.notes = [note for note in self.notes if note not in taken_back]
        self.doubts = [one for one in self.doubts or [] if one not in self.inconsistencies]
        self.inconsistencies = []

    def compared(
        self,
        fits: "Sequence[RTAC | Fit | PredictorFit]",
        labels: Sequence[str] | None = None,
        *,
        ahead: int | None = None,
    ) -> tuple[Any, Any]:
        """Compare fits with the training part and with what was held out, or None; predicting some samples ahead, if asked."""
        import estimators as est

        options: Any = {"labels": labels, "ahead": ahead, "hold_diverging": True}
        tested = None if self.held_out is None else est.compare(fits, self.held_out, **options)
        trained = est.compare(fits, self.train, **options)
        for comparison in (trained, tested):
            if comparison is not None and comparison.divergence:
                self.say(comparison.divergence)
        return trained, tested

    def save(self, result: "Result", path: Path | None) -> None:
        """Keep a result, if a file was named."""
        if path is not None:
            from rtac_jax.storage import ResultFileError

            try:
                result.save(path)
            except ResultFileError as error:
                stop(WRONG_USE, f"--save: {error}")
            self.said.append(f"saved: {path}")


@contextmanager
def job(
    file: Path,
    validation: str | None = None,
    out: Path | None = None,
    json: Path | None = None,
    save: Path | None = None,
) -> Iterator[Job]:
    """Yield a command's work on a recording; what goes wrong inside becomes one sentence and an exit status."""
    began = time.perf_counter()
    with answering():
        from rtac_jax.measurement import hum_subtracted

        folder = None if out is None else writable_folder(out)
        if json is not None:
            writable_file(json, "--json")
        if save is not None:
            saving_to(save)
        recording = load(file)
        prepare()
        hum = hum_subtracted(recording.hum())
        work = Job(file.name, recording.without_hum(), validation, folder, json, began)
        work.path = file
        if hum:  # on the screen too, as not every command prints the remark
            work.note(hum)
            typer.echo(f"rtac: {hum}", err=True)
        with printed_last(work):
            yield work


@contextmanager
def printed_last(work: Job) -> Iterator[Job]:
    """Print what a job says when its files are written; also where one cannot be, so that no result is lost."""
    try:
        yield work
    finally:
        if work.said:
            say(*work.said)


def load(file: Path) -> Any:
    """Load the recording."""
    from rtac_jax.measurement import Recording

    return Recording.load(file)


def prepare() -> None:
    """Prepare JAX and matplotlib, before anything is computed or drawn."""
    import matplotlib

    import rtac_jax

    matplotlib.use("Agg")
    say_once_that_the_cache_is_full()
    note_cache(rtac_jax.configure())


def say(*blocks: object) -> None:
    """Print paragraphs and tables, an empty line between them."""
    typer.echo("\n\n".join(str(block) for block in blocks if str(block)))


def _names(recording: "Recording", validation: str | None) -> list[str] | None:
    """Return the experiments named on the command line; a name may hold a comma itself."""
    if validation is None:
        return None
    if validation in recording.names:
        return [validation]
    names = [name.strip() for name in validation.split(",") if name.strip()]
    if not names:
        stop(WRONG_USE, f"--validation names no experiment; choose among {', '.join(recording.names)}.")
    return names


def _split(recording: "Recording", names: list[str] | None) -> tuple[Any, Any, str]:
    """Return train, validation or None, and why nothing could be held out."""
    from estimators.core.data import moving
    from rtac_jax.measurement import RecordingError

    try:
        return (*recording.split(names), "")
    except RecordingError as error:
        if names is not None:
            raise
        moving(recording)  # or no experiment can be cut in two
        return recording, None, str(error)
