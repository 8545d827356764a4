"""Workers of a diagnosis: threads that compute, and compile ahead of time, beside the one that asks."""

from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

from estimators.core.compilation import Ahead
from estimators.core.deadline import with_deadline
from estimators.core.threads import at_once, threads

One = TypeVar("One")
Answer = TypeVar("Answer")
Result = TypeVar("Result")


class Workers:
    """Threads beside the one that asks; what is computed does not depend on them."""

    def each(self, work: Callable[[One], Result], several: Sequence[One]) -> list[Result]:
        """Return `[work(one) for one in several]`."""
        return at_once(work, several)

    @contextmanager
    def compiling(
        self, pieces: Sequence[Callable[[], None]], *, before: Callable[[], None] | None = None
    ) -> Generator[Ahead, None, None]:
        """Compile pieces of code on two other threads, while this one goes on: tracing on one waits for no compiler.

        Args:
            pieces: each compiles code, in the order in which that will run.
            before: compiles what runs before all of them.
        """
        with ThreadPoolExecutor(2) as other:
            if before is not None:
                other.submit(before)
            yield Ahead(other, pieces)

    def first_beside(
        self,
        pieces: Sequence[Callable[[], None]],
        first: Callable[[], One | None],
        test: Callable[[One, Ahead], Answer],
        others: Sequence[Callable[[], One | None]],
    ) -> tuple[One | None, Answer | None, list[One | None]]:
        """Compute the first and its test, while its test is compiled, and the others are computed, on other threads.

        Args:
            pieces: compile the code of the test.
            first: computes what is tested; None where it cannot be.
            test: of what the first returned.
            others: compute the rest.
        """
        with ThreadPoolExecutor(threads() - 1) as pool:
            code = Ahead(pool, pieces)
            begun = [pool.submit(with_deadline(other)) for other in others]
            try:
                found = first()
                answer = None if found is None else test(found, code)
                # What no other thread has begun is done here, the last first, so that the two meet.
                places = range(len(others))
                here = {place: others[place]() for place in reversed(places) if begun[place].cancel()}
                rest = [here[place] if place in here else begun[place].result() for place in places]
            finally:
                pool.shutdown(wait=False, cancel_futures=True)
        return found, answer, rest
