"""Files of models and results: exact, checked, of a stated version, and never pickled."""

from rtac_jax.storage._file import ResultFileError, is_result_file, load, save

__all__ = ["ResultFileError", "is_result_file", "load", "save"]
