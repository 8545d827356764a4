"""Threads for independent work: compiled code hardly uses more than one core, a step of time being so small."""

import os
import threading
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from typing import Any, TypeVar

from threadpoolctl import OpenBLASController, ThreadpoolController

from estimators.core.deadline import with_deadline

One = TypeVar("One")
Result = TypeVar("Result")

_MOST = 4  # every one of them holds results of its own in memory
_here = threading.local()


def threads() -> int:
    """Return the number of threads that compute at the same time: at least two, so that one may wait for a compiler."""
    return max(2, min(_MOST, os.cpu_count() or 1))


def at_once(work: Callable[[One], Result], several: Sequence[One]) -> list[Result]:
    """Return `[work(one) for one in several]`, computed on a few threads.

    Where one raises, those that have not begun are left out. Work that itself asks for more at once is done one after
    the other.

    Compiled code that is run so must not factor large batches of matrices by LAPACK: jaxlib lets the threads that XLA
    has, as many as there are cores, wait within such a batch for others of them, so that two batches can wait for each
    other for ever. One matrix after the other, as by `jax.lax.map`, does not, nor does a batch of less than 2e5
    operations.
    """
    if len(several) < 2 or getattr(_here, "at_work", False):
        return [work(one) for one in several]
    with one_blas_thread(), ThreadPoolExecutor(threads(), initializer=_begin) as pool:
        begun = [pool.submit(with_deadline(work), one) for one in several]
        try:
            return [one.result() for one in begun]
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


@contextmanager
def one_thread() -> Generator[None, None, None]:
    """Let this thread do one thing after the other, where other processes have the other cores."""
    before = getattr(_here, "at_work", False)
    _here.at_work = True
    try:
        yield
    finally:
        _here.at_work = before


class _OneBlasThread:
    """The count of those who ask for one thread of linear algebra, which is a setting of the process.

    The last to let go gives back what the first has taken, whichever threads these are.
    """

    def __init__(self) -> None:
        self._lock, self._asked = threading.Lock(), 0
        self._limit: AbstractContextManager[Any] | None = None

    def ask(self) -> None:
        """Limit the libraries of linear algebra, if nobody else asks already."""
        with self._lock:
            self._asked += 1
            if self._asked == 1:
                _let_any_thread_limit()
                limit: AbstractContextManager[Any] = _libraries().limit(limits=1, user_api="blas")
                limit.__enter__()
                self._limit = limit

    def let_go(self) -> None:
        """Give the libraries back the threads that they had, if nobody else asks."""
        with self._lock:
            self._asked -= 1
            if self._asked == 0 and self._limit is not None:
                _let_any_thread_limit()
                self._limit.__exit__(None, None, None)


def _let_any_thread_limit() -> None:
    """Forget which thread has set the number first: from 3.8 on, threadpoolctl lets no other thread change it."""
    forget = getattr(OpenBLASController, "clear_controlling_thread", None)
    if forget is not None:
        forget(force=True)


_blas = _OneBlasThread()


@contextmanager
def one_blas_thread() -> Generator[None, None, None]:
    """Let NumPy and SciPy factor matrices by one thread; also as a decorator.

    The matrices of a fit are small, or tall and factored side by side. Threads of the library would wait for each other, busily,
    on the cores that compute and compile: a diagnosis takes a fifth longer.
    """
    _blas.ask()
    try:
        yield
    finally:
        _blas.let_go()


@cache
def _libraries() -> ThreadpoolController:
    """Return what the process has loaded; to look takes milliseconds."""
    return ThreadpoolController()


def _begin() -> None:
    _here.at_work = True
