"""Numerical work on the results of compiled code, done while the next of them are computed."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

One = TypeVar("One")
Result = TypeVar("Result")


def beside(work: Callable[[One], Result], computed: Iterable[One]) -> list[Result]:
    """`[work(one) for one in computed]`, where the iterable goes on while another thread works on what it gave.

    The work must not run compiled code: two threads that do can lock up XLA on a CPU.
    """
    with ThreadPoolExecutor(1) as other:
        return [one.result() for one in [other.submit(work, one) for one in computed]]
