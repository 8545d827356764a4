"""Compiled programs that outlive the process: what was traced and compiled once is loaded, not traced again."""

from rtac_jax.programs.compiled_function import Program, forget_programs, program

__all__ = ["Program", "forget_programs", "program"]
