"""Atomic writing: a file takes the place of another only when it is complete."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

unfinished: set[Path] = set()
"""What is being written just now; whoever ends the process removes it."""


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a path to write to, which takes the place of the other at the end.

    An interrupted write leaves an earlier file as it was. A device or a pipe, as /dev/stdout, is written to as it is: a file that
    took its place would stay there.

    Raises:
        FileNotFoundError: there is no such folder.
        OSError: there is no room, or it cannot be written; it names the path, not the one beside it.
    """
    given = Path(path)
    if given.exists() and not (given.is_file() or given.is_dir()):
        with _named(given, given):
            yield given
        return
    path = given.resolve()
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path.parent}: there is no such folder to save in; create it first.")
    # In the same folder, since a rename is atomic only within one file system.
    temporary = path.with_name(f".{secrets.token_hex(8)}.part")
    unfinished.add(temporary)
    try:
        with _named(path, temporary):
            yield temporary
            os.replace(temporary, path)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        unfinished.discard(temporary)


@contextmanager
def _named(path: Path, written: Path) -> Iterator[None]:
    """Name in errors the path that was asked for, not the one that is written."""
    try:
        yield
    except OSError as error:
        # Writing to an open file fails without a name, and renaming with two.
        if error.errno is None or error.filename not in (None, written, str(written)):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error
