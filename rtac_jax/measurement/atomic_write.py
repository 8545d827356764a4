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

    An interrupted write leaves an earlier file as it was.

    Raises:
        FileNotFoundError: there is no such folder.
        OSError: there is no room, or it cannot be written; it names the path, not the one beside it.
    """
    path = Path(path).resolve()
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path.parent}: there is no such folder to save in; create it first.")
    # In the same folder, since a rename is atomic only within one file system.
    temporary = path.with_name(f".{secrets.token_hex(8)}.part")
    unfinished.add(temporary)
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        # Writing to an open file fails without a name, and renaming with two.
        if error.errno is None or error.filename not in (None, temporary, str(temporary)):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        unfinished.discard(temporary)
