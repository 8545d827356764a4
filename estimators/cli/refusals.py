"""Refusals on the command line: one sentence and an exit status, for whatever goes wrong."""

import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

import typer

from estimators.cli.environment import reason

NOT_POSSIBLE, WRONG_USE, INTERRUPTED = 1, 2, 130

SINGULAR = (
    "what was asked cannot be computed ({}): the recording leaves something undetermined, or the model follows next to nothing of"
    " it; look at what rtac info says of signs, units and constants."
)

_shown = {"tracebacks": False}


@contextmanager
def answering() -> Iterator[None]:
    """Turn what may go wrong with data or files into one sentence and an exit status."""
    # Deferred, so that the help comes up without them.
    import numpy as np

    from estimators.core.results import DivergedError
    from rtac_jax.configuration import require_platform
    from rtac_jax.measurement import RecordingError

    try:
        require_platform()
    except RuntimeError as error:
        stop(WRONG_USE, str(error))
    try:
        yield
    except (RecordingError, OSError) as error:
        stop(WRONG_USE, _sentence(error))
    except np.linalg.LinAlgError as error:
        stop(NOT_POSSIBLE, SINGULAR.format(_sentence(error)))
    except (ValueError, DivergedError, ArithmeticError) as error:
        stop(NOT_POSSIBLE, _sentence(error))
    except KeyboardInterrupt:
        stop(INTERRUPTED, "interrupted; nothing that was not complete has been written.")
    except MemoryError:
        stop(INTERRUPTED, "there is not enough memory for this recording; cut it with Experiment.cut.")


def show_tracebacks(asked: bool) -> None:
    """Let every refusal come with the traceback of its cause, or not."""
    _shown["tracebacks"] = asked


def stop(status: int, sentence: str) -> NoReturn:
    """Say one sentence and end with a status; after the traceback, where `--debug` asked for it."""
    if _shown["tracebacks"] and sys.exc_info()[1] is not None:
        typer.echo(traceback.format_exc(), err=True)
    typer.echo(f"rtac: {sentence}", err=True)
    raise typer.Exit(status)


def _sentence(error: Exception) -> str:
    if isinstance(error, OSError) and error.errno is not None:
        return reason(error)
    return " ".join(str(error).split())
