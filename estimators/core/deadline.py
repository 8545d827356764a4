"""The time that optional work may take: whoever asks sets it, and what computes looks at it from step to step."""

import math
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from typing import ParamSpec, TypeVar

Given = ParamSpec("Given")
Answer = TypeVar("Answer")


SEARCHING = 0.75
"""Fraction of the time that is given in which it is asked what is missing; the rest is for what was named, and for last resorts."""
PROLONGED = 1 / SEARCHING - 1
"""Of the time for searching: so much more is there for what was named until then, and for last resorts."""


class OutOfTimeError(Exception):
    """A step that would begin after the time is over. It is no failure of a model, so no handler of those catches it."""


class Deadline:
    """The time at which optional work is broken off.

    Attributes:
        seconds: that are given from now on; infinite where the work may go on to its end.
        missed: whether work was broken off for it.
    """

    def __init__(self, seconds: float | None = None) -> None:
        self.seconds = math.inf if seconds is None else seconds
        self.missed = False
        self._at = time.monotonic() + self.seconds

    @classmethod
    def of_searching(cls, within: float | None) -> "Deadline":
        """Return the deadline of searching, where an answer is wanted after so many seconds; None for no end."""
        return cls(None if within is None else SEARCHING * within)

    @property
    def within(self) -> float:
        """Return the seconds that are left until an answer is wanted, from a deadline of searching."""
        return self.left / SEARCHING

    @property
    def over(self) -> bool:
        """Return whether the time is over."""
        return self.left <= 0

    @property
    def left(self) -> float:
        """Return the seconds that are left; less than nothing once they are over."""
        return self._at - time.monotonic()

    def prolonged(self, fraction: float) -> "Deadline":
        """Return a deadline that is later by a fraction of the seconds that were given."""
        return Deadline(self.left + fraction * self.seconds)

    @contextmanager
    def kept(self) -> Generator[None, None, None]:
        """Let what computes within, on this thread and on those that it asks, break off once the time is over."""
        before = _kept.set(self)
        try:
            yield
        finally:
            _kept.reset(before)


_kept: ContextVar[Deadline | None] = ContextVar("kept", default=None)


def require_time() -> None:
    """Refuse to begin a step after the time is over.

    Raises:
        OutOfTimeError: it is.
    """
    deadline = _kept.get()
    if deadline is not None and deadline.over:
        deadline.missed = True
        raise OutOfTimeError("The time that was given is over.")


def with_deadline(work: Callable[Given, Answer]) -> Callable[Given, Answer]:
    """Return work for another thread that keeps the deadline of this one."""
    context = copy_context()
    return lambda *given, **named: context.run(work, *given, **named)
