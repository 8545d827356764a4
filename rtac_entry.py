"""The first code that runs when `rtac` is called: signals and pipes are answered before anything heavy is imported.

Python answers a signal between two steps of its own code. Importing and compiling stay in foreign code for seconds, so
here the signal's number goes through a pipe to a thread, which says one sentence and ends the process at once. Nothing is
lost by that: every result is written aside and takes the place of an earlier one when it is complete.

Exit status after a signal, as shells have it: 130 after Ctrl-C (SIGINT), 143 after SIGTERM.

What Python has loaded itself when it comes here is imported at the top, and nothing else: before that is done nobody answers.
"""

from __future__ import annotations

import io
import os
import signal
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

SENTENCES = {
    signal.SIGINT: "interrupted; nothing that was not complete has been written.",
    signal.SIGTERM: "asked to stop (SIGTERM); nothing that was not complete has been written.",
}


def main() -> None:
    """Run the command line."""
    answer_signals()
    outlive_closed_pipes()
    import gc
    import logging

    # Where there is no home it takes a temporary folder, which harms nothing here and is worth no word.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    # Looking for unreachable cycles among half a million objects of JAX that all stay takes a tenth of a command.
    gc.disable()
    from estimators.cli import main as command  # after the above: it takes seconds

    gc.freeze()
    gc.set_threshold(50_000, 20, 100)
    gc.enable()
    try:
        command()
    finally:
        gc.disable()
        gc.freeze()  # or Python would go through all of them once more as it ends, for a second
        # All is said and written. While Python shuts down nothing answers any more, and an interrupt would kill it.
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def answer_signals() -> None:
    """End the process with a sentence when it is interrupted or asked to stop, whatever it is doing."""
    # A signal that whoever called wants to have ignored, as `nohup` or a background job does, stays ignored.
    answered = [number for number in SENTENCES if signal.getsignal(number) != signal.SIG_IGN]
    for number in answered:
        signal.signal(number, lambda number, _: _end(number))
    import threading

    receiving, sending = os.pipe()
    os.set_blocking(sending, False)
    signal.set_wakeup_fd(sending, warn_on_full_buffer=False)
    for number in answered:  # one of the two alone may say the sentence
        signal.signal(number, lambda *_: None)
    threading.Thread(target=_wait, args=(receiving,), name="signals", daemon=True).start()


def _wait(receiving: int) -> None:
    while True:
        number = os.read(receiving, 1)[0]
        if number in SENTENCES:
            _end(number)


_first = iter((True,))  # whoever takes what it holds, which one alone can, ends the process


def _end(number: int) -> None:
    if not next(_first, False):
        return  # a handler and the thread may both have heard the signal
    # What was being written lies beside its place under a name of its own. The module is only looked for, not imported.
    aside = getattr(sys.modules.get("rtac_jax.measurement.atomic_write"), "unfinished", ())
    for path in tuple(aside):
        try:
            os.unlink(path)
        except OSError:
            continue
    try:
        start = "\n" if os.isatty(2) else ""  # a bar may stand on the line
        os.write(2, f"{start}rtac: {SENTENCES[signal.Signals(number)]}\n".encode())
    finally:
        os._exit(128 + number)


def outlive_closed_pipes() -> None:
    """Let a command go on when nobody reads what it says, as with `rtac ... | head`: its files are still wanted."""
    for name in ("stdout", "stderr"):
        stream: Any = getattr(sys, name)
        if isinstance(stream, io.TextIOWrapper):
            patient = io.BufferedWriter(_Patient(stream.fileno(), "wb", closefd=False))
            options: dict[str, Any] = {"encoding": stream.encoding, "errors": stream.errors}
            setattr(sys, name, io.TextIOWrapper(patient, line_buffering=stream.line_buffering, **options))


class _Patient(io.FileIO):
    """A file that takes what is written to it even when its reader has gone, and that fails once where there is no room."""

    def write(self, content: Any, /) -> int:
        try:
            return super().write(content)
        except OSError as error:
            # What is still buffered would fail again when the process ends, with a traceback that nobody can catch.
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self.fileno())
            os.close(nowhere)
            if not isinstance(error, BrokenPipeError):
                raise
            return len(content)


if __name__ == "__main__":
    main()
