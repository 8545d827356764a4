"""The fingerprint of a traced function, a digest of all that determines its tracing: types, static values, and shapes of arrays."""

import dataclasses
import enum
import hashlib
import inspect
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np


class NoFingerprintError(Exception):
    """Something is not determined by its name and its values, such as a class whose source may change."""


@dataclasses.dataclass(frozen=True)
class Traced:
    """A mark in place of an array: as much as tracing sees of it.

    Attributes:
        shape: of it.
        dtype: by name.
    """

    shape: tuple[int, ...]
    dtype: str


def fingerprint(value: object, packages: Sequence[str]) -> str:
    """Return a digest of all that tracing sees of a value.

    Of classes and functions that is the name, of all else the value; an array is one that is not traced. A class that a function
    makes anew in each process says by which, and of what, in `made_by`; the function has to return the same class for the same.

    Args:
        value: `Traced` in place of arrays that are, in tuples, lists, dictionaries and data classes.
        packages: whose classes and functions their name determines, since their source is known.

    Raises:
        NoFingerprintError: a class or function of another package, or of no module, or anything else is among it.
    """
    digest = hashlib.sha256()
    for part in _parts(value, frozenset(packages)):
        digest.update(part.encode() + b"\0")
    return digest.hexdigest()[:40]


def _parts(value: Any, packages: frozenset[str]) -> Iterator[str]:
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        held = np.asarray(value)
        yield f"array {held.shape} {held.dtype} {hashlib.sha256(held.tobytes()).hexdigest()}"
    elif isinstance(value, jax.ShapeDtypeStruct) and value.sharding is None:
        yield f"shape {value.shape} {value.dtype} {value.weak_type}"
    elif isinstance(value, jax.tree_util.PyTreeDef):
        structure: Any = value
        node, children = structure.node_data(), structure.children()
        yield f"structure {len(children)}"
        yield from _parts(node, packages)
        for child in children:
            yield from _parts(child, packages)
    elif isinstance(value, type) or inspect.isfunction(value):
        yield f"name {_name(value, packages)}"
    elif isinstance(value, enum.Enum):
        yield f"member {_name(type(value), packages)}.{value.name}"
    elif value is None or type(value) in (bool, int, float, complex, str, bytes):
        yield f"{type(value).__name__} {value!r}"
    elif dataclasses.is_dataclass(value):
        fields = [field.name for field in dataclasses.fields(value)]
        yield f"record {_name(type(value), packages)} {len(fields)}"
        for name in fields:
            yield name
            yield from _parts(getattr(value, name, None), packages)
    elif isinstance(value, tuple | list):
        named = f" {_name(type(value), packages)}" if hasattr(value, "_fields") else ""
        yield f"{'tuple' if isinstance(value, tuple) else 'list'}{named} {len(value)}"
        for one in value:
            yield from _parts(one, packages)
    elif isinstance(value, frozenset):
        yield f"set {len(value)}"
        yield from sorted("\0".join(_parts(one, packages)) for one in value)
    elif type(value) is dict:
        yield f"dict {len(value)}"
        for key, one in value.items():
            yield from _parts(key, packages)
            yield from _parts(one, packages)
    else:
        raise NoFingerprintError(type(value).__name__)


def _name(named: Any, packages: frozenset[str]) -> str:
    if named is type(None):
        return "None"
    if isinstance(named, type) and (made_by := vars(named).get("made_by")):
        function, arguments = made_by
        if function(*arguments) is not named:
            raise NoFingerprintError(named.__qualname__)
        return f"{_name(function, packages)} {fingerprint(arguments, tuple(packages))}"
    module, path = named.__module__, named.__qualname__
    if module.partition(".")[0] not in packages | {"builtins"} or "<" in path:
        raise NoFingerprintError(f"{module}.{path}")
    found: Any = sys.modules.get(module)
    for part in path.split("."):
        found = getattr(found, part, None)
    if inspect.unwrap(getattr(found, "_function", found)) is not inspect.unwrap(named):
        raise NoFingerprintError(f"{module}.{path}")  # replaced, or another of the same name
    return f"{module}.{path}"
