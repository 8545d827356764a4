"""A compiled function that is found again in another process."""

import functools
import threading
import weakref
from collections.abc import Callable, Hashable, Sequence
from pathlib import Path
from typing import Any, Generic, NamedTuple, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from rtac_jax.programs.collection import collected_later
from rtac_jax.programs.compiler import compile_lowered
from rtac_jax.programs.environment import LIBRARIES, PACKAGES, environment
from rtac_jax.programs.files import (
    Kept,
    code_file,
    compile_and_save,
    folder,
    loaded,
    loaded_code,
    save,
)  # fmt: skip
from rtac_jax.programs.fingerprint import NoFingerprintError, Traced, fingerprint
from rtac_jax.programs.heap import give_back

Given = ParamSpec("Given")
Result = TypeVar("Result")

_compiling: list[str] = []
_all: "weakref.WeakSet[Program[Any, Any]]" = weakref.WeakSet()


class _Made(NamedTuple):
    """A program for arguments of one structure.

    Attributes:
        run: what is called with all arrays; None where the result is not made of arrays alone.
        structure: of the result.
    """

    run: Callable[..., Sequence[Any]] | None
    structure: Any


class _NotOnlyArraysError(Exception):
    """A function returns something else besides."""


class _Entry:
    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.made: _Made | None = None


class Program(Generic[Given, Result]):
    """A function that is compiled once for each structure of its arguments, in all processes together.

    It does what `equinox.filter_jit` does: arrays are traced, all else is part of the structure. JAX keeps compiled code
    between processes too, but finds it by what tracing gives, and tracing is most of the work where nothing has to be
    compiled. Here code is found by what determines the tracing: the function, the structure of its arguments, the source of
    the package, the versions of its libraries, JAX's settings and the processor. Where one of these cannot be told for certain, as
    for a user's own effect, whose source may change, the function is traced as usual.
    """

    def __init__(self, function: Callable[Given, Result]) -> None:
        functools.update_wrapper(self, function)
        self._function: Any = function
        self._name = function.__name__
        self._jitted: Any = eqx.filter_jit(function)
        self._entries: dict[Hashable, _Entry] = {}
        _all.add(self)

    def __call__(self, *args: Given.args, **kwargs: Given.kwargs) -> Result:
        """Run the function."""
        leaves, structure = jax.tree.flatten((args, kwargs))
        if not _can_be_kept(leaves):
            return self._jitted(*args, **kwargs)
        made = self._made(leaves, structure)
        give_back()
        if made.run is None:
            return self._jitted(*args, **kwargs)
        return jax.tree.unflatten(made.structure, made.run(*filter(_is_array, leaves)))

    def prepare(self, *args: Given.args, **kwargs: Given.kwargs) -> None:
        """Compile or load what a call with such arguments runs, and run nothing."""
        leaves, structure = jax.tree.flatten((args, kwargs))
        if not _can_be_kept(leaves) or self._made(leaves, structure).run is None:
            self._jitted.lower(*args, **kwargs).compile()

    @property
    def compiled(self) -> int:
        """Return for how many structures of arguments this process holds code."""
        return len(self._entries)

    def forget(self) -> None:
        """Drop what this process holds of it."""
        self._entries.clear()

    def _made(self, leaves: Sequence[Any], structure: Any) -> _Made:
        key = structure, jnp.result_type(float), tuple(_shown(x) if _is_array(x) else (type(x), x) for x in leaves)
        entry = self._entries.setdefault(key, _Entry())
        if entry.made is None:
            with entry.lock:  # of several threads one compiles
                if entry.made is None:
                    _compiling.append(self._name)
                    try:
                        entry.made = self._loaded_or_compiled(leaves, structure)
                    finally:
                        _compiling.remove(self._name)
        return entry.made

    def _loaded_or_compiled(self, leaves: Sequence[Any], structure: Any) -> _Made:
        file = self._file(leaves, structure)
        if file is not None and (found := loaded(file)) is not None:
            return _Made(found[0], found[1].structure)
        shapes: list[Any] = []

        def flat(*arrays: Any) -> list[Any]:
            left = iter(arrays)
            args, kwargs = jax.tree.unflatten(structure, [next(left) if _is_array(x) else x for x in leaves])
            found, shape = jax.tree.flatten(self._function(*args, **kwargs))
            if not all(map(_is_array, found)):
                raise _NotOnlyArraysError
            shapes.append(shape)
            return found

        # A name of its own, also in JAX's cache: code that is loaded from there cannot be kept here.
        flat.__name__ = f"program_{self._name}"
        try:
            # No type gives way to others, as that of an array made of a number does: each would be a program more.
            with collected_later():  # a search for garbage would take a fifth of the time
                lowered = jax.jit(flat).lower(*(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves if _is_array(x)))
        except _NotOnlyArraysError:
            return _Made(None, None)
        code = None if file is None else code_file(file.parents[1], self._name, lowered)
        if file is None or code is None:
            return _Made(compile_lowered(lowered), shapes[0])
        given = sum(map(_is_array, leaves))
        run = loaded_code(code, given, shapes[0].num_leaves) or compile_and_save(lowered, code)
        save(file, Kept(code.name, given, jax.tree.unflatten(shapes[0], range(shapes[0].num_leaves))))
        return _Made(run, shapes[0])

    def _file(self, leaves: Sequence[Any], structure: Any) -> Path | None:
        """Return where the program is kept; None where nothing is, or where what determines it cannot be told."""
        if (kept := folder()) is None:
            return None
        given = jax.tree.unflatten(structure, [Traced(*_shown(x)) if _is_array(x) else x for x in leaves])
        try:
            own = fingerprint((self._function, given), (*PACKAGES, *LIBRARIES))
        except NoFingerprintError:
            return None
        return kept / environment() / f"{self._name}-{own}"


def program(function: Callable[Given, Result]) -> Program[Given, Result]:
    """Make a function of arrays a `Program`."""
    return Program(function)


def compiling() -> tuple[str, ...]:
    """Return the names of the functions that threads of this process trace, compile or load at this moment."""
    return tuple(_compiling)


def forget_programs() -> None:
    """Drop what this process holds of all programs; those on disk stay."""
    for one in list(_all):
        one.forget()


def _is_array(leaf: object) -> bool:
    """Return whether a leaf is traced; of one that is only prepared for, the shape may stand there."""
    return isinstance(leaf, jax.Array | np.ndarray | np.generic | jax.ShapeDtypeStruct)


def _can_be_kept(leaves: Sequence[object]) -> bool:
    """Return whether nothing is traced or watched, as by `jax.debug_nans`, and all arrays are on one device."""
    config: Any = jax.config
    return not (
        any(isinstance(leaf, Tracer) for leaf in leaves)
        or config.jax_disable_jit
        or config.jax_debug_nans
        or config.jax_debug_infs
        or jax.device_count() > 1
    )


def _shown(array: Any) -> tuple[tuple[int, ...], str]:
    """Return what tracing sees of an array: shape and type."""
    return array.shape, str(array.dtype)
