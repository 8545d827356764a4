"""The lacks of a machine: a platform for JAX, room on a disk, a folder that can be written to; each as one sentence."""

import errno
import os
import warnings
from typing import Any

import typer

# What usually helps, by the system's number of the error.
MENDS = {
    errno.ENOSPC: "make room there, or name another place",
    errno.EDQUOT: "make room there, or name another place",
    errno.EFBIG: "raise the limit on the size of files (ulimit -f), or name another place",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.EISDIR: "name a file, not a folder",
    errno.ENOTDIR: "name a folder, not a file",
    errno.EACCES: "name another place, or ask for the right to use this one",
    errno.EPERM: "name another place, or ask for the right to use this one",
    errno.EROFS: "name a place that can be written to",
    errno.EIO: "check the disk, and copy what is on it",
    errno.EMFILE: "raise the limit on open files (ulimit -n)",
    errno.ENOMEM: "cut the recording with Experiment.cut",
}
_ELSEWHERE = "name another place"


def reason(error: OSError) -> str:
    """Return one sentence with the place, what the system says, and what helps."""
    place = error.filename if error.filename is not None else "the output"
    return f"{os.fspath(place)}: {error.strerror or error}; {MENDS.get(error.errno or 0, _ELSEWHERE)}."


def note_cache(configured: str) -> None:
    """Say on stderr when compiled code cannot be kept, which costs time and nothing else."""
    from rtac_jax.configuration import NO_CACHE

    if NO_CACHE in configured:  # which comes last
        typer.echo(f"rtac: {configured[configured.index(NO_CACHE) :]}", err=True)


def say_once_that_the_cache_is_full() -> None:
    """Say on stderr, once, what JAX would warn of at every function that it compiles."""
    show, said = warnings.showwarning, set[str]()

    def shown(message: Warning | str, *others: Any, **more: Any) -> None:
        text = str(message)
        if "persistent compilation cache entry" not in text:
            show(message, *others, **more)
        elif not said:
            said.add(text)
            why = text.rpartition(": ")[2].partition("] ")[2] or text
            typer.echo(
                f"rtac: compiled code cannot be kept ({why}), so every run compiles anew; make room, or let "
                "JAX_COMPILATION_CACHE_DIR name another folder.",
                err=True,
            )

    warnings.showwarning = shown
