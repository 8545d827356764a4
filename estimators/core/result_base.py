"""The base of results: each can be saved, and shows itself in a line or as a small table."""

import os
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

from rtac_jax import storage
from rtac_jax.effects import Effect
from rtac_jax.overview import Overview

PACKAGES = ("rtac_jax", "estimators")
"""Packages whose records may be in a file."""


class Result:
    """A result: `print` shows all of it, a notebook a small table, `repr` one line."""

    __slots__ = ()

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result to a file (".h5") from which `estimators.load` returns the same, bit for bit.

        Raises:
            ResultFileError: another ending.
            OSError: it cannot be written.
        """
        save(self, path)

    @abstractmethod
    def overview(self) -> Overview:
        """Return the gist of the result."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}: {self.overview().title}"

    def _repr_html_(self) -> str:
        return self.overview().to_html()


def save(result: object, path: str | os.PathLike[str]) -> None:
    """Write a model or a result to a file, from which `load` returns the same, bit for bit.

    A file that was there is replaced only when the new one is complete.

    Args:
        result: a model, a fit, a diagnosis, an envelope, a controller, or another result.
        path: of the file, ending in ".h5" or ".hdf5".

    Raises:
        ResultFileError: another ending, or something inside that a file does not hold.
        FileNotFoundError: there is no such folder.
        OSError: it cannot be written.
    """
    storage.save(result, path, packages=PACKAGES)


def load(path: str | os.PathLike[str], *, effects: Sequence[type[Effect]] = ()) -> Any:
    """Return the model or result that `save` wrote, the same bit for bit.

    Args:
        path: of the file.
        effects: classes of effects of your own that may be in it; those of the catalogue are known.

    Raises:
        FileNotFoundError: there is no such file.
        ResultFileError: it is no file of results, damaged, of another version, or holds an effect that is not there.
        RuntimeError: JAX was not configured for double precision.
    """
    return storage.load(path, effects=effects, packages=PACKAGES)
