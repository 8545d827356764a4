"""Frozen records that read and write tables of TOML: types are checked, and what is unknown is refused in one sentence."""

import dataclasses
import functools
import types
import typing
from collections.abc import Iterator, Mapping
from typing import Any, TypeVar, cast

Record = TypeVar("Record")


class SpecError(ValueError):
    """A study that is not described as it must be; the message names the place."""


class Values(Mapping[str, Any]):
    """A mapping that cannot change, so that what holds it can be hashed; lists inside become tuples."""

    def __init__(self, given: Mapping[str, Any] | None = None) -> None:
        self._given = {str(key): frozen(value) for key, value in (given or {}).items()}

    def __getitem__(self, key: str) -> Any:
        return self._given[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._given)

    def __len__(self) -> int:
        return len(self._given)

    def __hash__(self) -> int:
        return hash(frozenset(self._given.items()))

    def __repr__(self) -> str:
        return f"Values({self._given})"


def frozen(value: object) -> Any:
    """Return the value with lists as tuples and tables as `Values`."""
    if isinstance(value, Mapping):
        return value if isinstance(value, Values) else Values(value)
    if isinstance(value, list | tuple):
        return tuple(frozen(part) for part in value)
    return value


@functools.cache
def _types_of(record: type) -> dict[str, Any]:
    return typing.get_type_hints(record)


def freeze_fields(record: object, place: str) -> None:
    """Bring every field of a frozen record to its declared type, as its `__post_init__` does first.

    Raises:
        SpecError: a field has another type; the message names it.
    """
    for name, declared in _types_of(type(record)).items():
        where = f"{place}.{name}" if place else name
        object.__setattr__(record, name, _converted(getattr(record, name), declared, where))


def from_table(record: type[Record], table: Mapping[str, Any], place: str) -> Record:
    """Return a record from a table of TOML.

    Raises:
        SpecError: a key is unknown or missing, or a value has the wrong type.
    """
    known = {field.name: field for field in dataclasses.fields(cast(Any, record))}
    for key in table:
        if key not in known:
            where = f"[{place}] " if place else ""
            raise SpecError(f"{where}{key}: there is no such key; use one of {', '.join(known)}.")
    for name, field in known.items():
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if required and name not in table:
            raise SpecError(f"{f'[{place}] ' if place else ''}{name}: is missing; every study needs it.")
    hints = _types_of(record)
    given = {
        key: _converted(value, hints[key], f"{place}.{key}" if place else key, read=True)
        for key, value in table.items()
    }
    return record(**given)


def to_table(record: object) -> Any:
    """Return the record as plain dictionaries, lists and scalars, every field stated."""
    if dataclasses.is_dataclass(record):
        return {field.name: to_table(getattr(record, field.name)) for field in dataclasses.fields(record)}
    if isinstance(record, Mapping):
        return {key: to_table(value) for key, value in record.items()}
    if isinstance(record, tuple):
        return [to_table(part) for part in record]
    return record


def _converted(value: object, declared: Any, place: str, *, read: bool = False) -> Any:
    """Return the value in the declared type; tables become records only where a file is `read`."""
    origin = typing.get_origin(declared)
    if origin is typing.Literal:
        choices = typing.get_args(declared)
        if value not in choices:
            raise SpecError(f"{place}: is {value!r}; use one of {', '.join(map(repr, choices))}.")
        return value
    if origin in (typing.Union, types.UnionType):  # a number, or a mapping in either form
        options = typing.get_args(declared)
        declared = float if float in options else Values
        origin = None
    if origin is tuple:
        inner = typing.get_args(declared)[0]
        if not isinstance(value, list | tuple):
            raise SpecError(f"{place}: is {_kind(value)}, but a list is needed.")
        return tuple(_converted(part, inner, f"{place}[{n}]", read=read) for n, part in enumerate(value))
    if dataclasses.is_dataclass(declared):
        if read and isinstance(value, Mapping):
            return from_table(cast(type, declared), value, place)
        if not isinstance(value, cast(type, declared)):
            raise SpecError(f"{place}: is {_kind(value)}, but a table is needed.")
        return value
    if declared is Values:
        if not isinstance(value, Mapping):
            raise SpecError(f"{place}: is {_kind(value)}, but a table is needed.")
        return frozen(value)
    if declared is float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise SpecError(f"{place}: is {_kind(value)}, but a number is needed.")
        return float(value)
    if isinstance(value, bool) is not (declared is bool) or not isinstance(value, declared):
        needed = {int: "a whole number", str: "a string", bool: "true or false"}[declared]
        raise SpecError(f"{place}: is {_kind(value)}, but {needed} is needed.")
    return value


def _kind(value: object) -> str:
    if isinstance(value, Mapping):
        return "a table"
    if isinstance(value, list | tuple):
        return "a list"
    return repr(value)
