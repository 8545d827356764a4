"""Files of models and results: exact, checked, of a stated version, and never pickled."""

from rtac_jax.storage._file import ENDINGS, ResultFileError, is_result_file, load, save

__all__ = ["ENDINGS", "ResultFileError", "is_result_file", "load", "save"]
