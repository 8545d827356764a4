"""The places that a command writes to, tried before anything is computed."""

import os
import secrets
import stat
from collections.abc import Collection
from pathlib import Path

from estimators.cli.refusals import WRONG_USE, stop

_FOREIGN = (".csv", ".mat", ".tsv", ".txt", ".dat")  # of files that a logger may have written


def saving_to(path: Path) -> None:
    """Try, before anything is computed, whether a result can be kept in a file."""
    from rtac_jax.storage import ENDINGS

    if path.suffix.lower() not in ENDINGS:
        stop(WRONG_USE, f"--save: is {path}; let the name end in {' or '.join(ENDINGS)}.")
    writable_file(path, "--save")


def writable_folder(folder: Path) -> Path:
    """Return the folder, made if need be, and tried before anything is computed."""
    probe = folder / f".{secrets.token_hex(4)}.part"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch(exist_ok=False)
        os.unlink(probe)
    except OSError as error:
        stop(WRONG_USE, f"{folder}: cannot be written to ({error.strerror}); name another place.")
    return folder


def writable_file(file: Path, option: str, *, replace: bool | None = None, written: Collection[str] = ()) -> None:
    """Try, before anything is computed, whether a file can be written; its folder is made if need be.

    A recording of measurements is not written over, nor what a logger may have written: nobody may be able to make them again.

    Args:
        file: to be written.
        option: that names it.
        replace: the user asks for it to be written over, whatever it holds; None where a command knows no such wish.
        written: endings of the tables that the option itself writes, over which it may write again.
    """
    if str(file) == "-":
        stop(WRONG_USE, f"{option}: standard output holds what is printed; name a file.")
    if file.parent.is_dir():
        try:
            is_folder = stat.S_ISDIR(os.stat(file).st_mode)
        except FileNotFoundError:
            is_folder = False
        except OSError as error:
            stop(WRONG_USE, f"{file}: cannot be written to ({error.strerror}); name another file for {option}.")
        if is_folder:
            stop(WRONG_USE, f"{file}: is a folder; name a file for {option}.")
        ending = file.suffix.lower()
        foreign = ending in _FOREIGN and ending not in written and file.is_file()
        if not replace and (foreign or _holds_measurements(file)):
            mend = "name another file" if replace is None else "name another file, or add --replace"
            holds = "may hold measurements" if foreign else "holds a recording"
            stop(WRONG_USE, f"{file}: {holds}, which would be lost; {mend} for {option}.")
    writable_folder(file.parent)


def _holds_measurements(file: Path) -> bool:
    if not file.is_file():
        return False
    # Deferred, so that a command that writes anew starts without it.
    from rtac_jax.measurement import holds_measurements

    return holds_measurements(file)
