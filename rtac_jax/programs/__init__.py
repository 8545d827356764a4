"""Compiled programs that outlive the process: what was traced and compiled once is loaded, not traced again."""

from rtac_jax.programs.compiled_function import Program, compiling, forget_programs, program

__all__ = ["Program", "compiling", "forget_programs", "program"]
