"""Progress of work that takes seconds or hours, told to people at a terminal and to those who read a log."""

import math
import sys
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any

from tqdm import tqdm

from rtac_jax.programs import compiling

Tell = Callable[[str], object]
"""What is called with a line of text after every step of some work."""

_REFRESH = 1.0  # s, of a bar, so that its clock goes on while code compiles
_LINE = 60.0  # s between lines where nobody watches


class _Clock:
    """When the next line of a log is due; one for the process, since long work may be made of many short parts."""

    def __init__(self) -> None:
        self._lock, self._due = threading.Lock(), -math.inf

    def begin(self) -> None:
        """Let a line be due in a minute, unless work that was going on a minute ago goes on."""
        with self._lock:
            now = time.monotonic()
            if now > self._due + _LINE:
                self._due = now + _LINE

    def left(self) -> float:
        """Return the seconds until the next line is due."""
        return max(self._due - time.monotonic(), 0.0)

    def is_due(self) -> bool:
        """Return whether a line is due, and let the next be due in a minute; of several that ask one is told so."""
        with self._lock:
            now = time.monotonic()
            due = now >= self._due
            self._due = now + _LINE if due else self._due
            return due


_clock = _Clock()


class Progress:
    """A bar at a terminal or in a notebook, one line a minute in a log; it says what is done, how fast, and what compiles.

    Where the total is known it says what time is left. Several threads may report to one.
    """

    def __init__(self, task: str, *, show: bool, unit: str = "steps", total: int | None = None, done: int = 0) -> None:
        """Begin to report.

        Args:
            task: what is done.
            show: whether anything is to be shown.
            unit: what is counted.
            total: how many there are, where that is known.
            done: how many are done already.
        """
        self._show, self._watched = show, show and watched()
        self._began, self._note = time.monotonic(), ""
        self._bar = tqdm(total=total, initial=done, desc=task, unit=f" {unit}", leave=False, disable=not self._watched)
        self._task, self._unit, self._total, self._done, self._first = task, unit, total, done, done
        self._ended = threading.Event()
        _clock.begin()
        if show:
            threading.Thread(target=self._tick, daemon=True).start()

    def __enter__(self) -> "Progress":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._bar.close()

    def at(self, task: str) -> None:
        """Say what is done from here on."""
        self._task, self._note = task, ""
        self._bar.set_description_str(task)

    def step(self, note: str = "") -> None:
        """Count one, and note how the work stands."""
        self._note = note
        self._bar.set_postfix_str(note, refresh=False)
        self.count(1)

    def count(self, number: int = 1) -> None:
        """Count what is done."""
        self._done += number
        self._bar.update(number)

    def say(self, sentence: str) -> None:
        """Print a sentence beside what is shown."""
        if self._show:
            self._bar.write(sentence, file=sys.stderr)

    def line(self) -> str:
        """Return what a bar would show, as a line of a log."""
        total: Any = self._total  # None is meant, whatever the library's types say
        return tqdm.format_meter(
            self._done, total, time.monotonic() - self._began, ncols=0, prefix=self._task, unit=f" {self._unit}",
            postfix=self._state(), initial=self._first,
        )  # fmt: skip

    def _state(self) -> str:
        names = dict.fromkeys(name.strip("_").replace("_", " ") for name in compiling())
        return f"compiling {', '.join(names)}" if names else self._note

    def _tick(self) -> None:
        while not self._ended.wait(_REFRESH if self._watched else _clock.left()):
            if self._watched:
                self._bar.set_postfix_str(self._state())
            elif _clock.is_due():
                print(self.line(), file=sys.stderr, flush=True)


def watched() -> bool:
    """Return whether somebody looks at what is printed: at a terminal, or in a notebook."""
    return sys.stderr.isatty() or type(sys.stderr).__module__.partition(".")[0] == "ipykernel"
