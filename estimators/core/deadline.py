"""The time that optional work may take: whoever asks sets it, and what computes looks at it from step to step."""

import math
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from typing import ParamSpec, TypeVar

Given = ParamSpec("Given")
Answer = TypeVar("Answer")


PROLONGED = 1 / 3
"""Of the time that is given: so much more for what was named until then, and for last resorts."""


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
