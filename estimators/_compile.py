"""Compiling ahead of time."""

from typing import Any


def compile_only(function: Any, *arguments: Any) -> None:
    """Compile a jitted function for arguments of these shapes, and run nothing.

    For a thread beside the one that computes: two threads that compute at the same time can lock up XLA on a CPU,
    compiling in one while another computes cannot.
    """
    function.lower(*arguments).compile()
