"""Encoding of records as JSON and arrays: what a result is made of, by name, bit for bit."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import control as ct
import jax
import numpy as np

from rtac_jax.effects import CATALOGUE, Effect
from rtac_jax.effects.formula_force import FormulaForce
from rtac_jax.storage._errors import ResultFileError

KIND = "is"
"""Key of a JSON object that says what it stands for; every object has it."""

NUMBERS = "biufc"
"""Kinds of arrays that a file holds: truth values, integers, real and complex numbers."""

_NOT_FINITE = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


class Encoder:
    """Encodes one result; the arrays that it meets are collected in `arrays`, each once.

    Args:
        packages: whose records are encoded by their names; an effect of any other is the user's own.
    """

    def __init__(self, packages: tuple[str, ...]) -> None:
        self.packages = packages
        self.arrays: list[np.ndarray] = []
        self._places: dict[int, int] = {}
        self._kept: list[Any] = []  # so that no identity is used twice

    def encode(self, value: Any, place: str) -> Any:
        """Return a value as JSON knows it.

        Args:
            value: a record, or what one holds.
            place: of the value, for a refusal.

        Raises:
            ResultFileError: it is something that a file does not hold, such as a function.
        """
        if value is None or type(value) in (bool, int, str):
            return value
        if type(value) is float:
            return value if math.isfinite(value) else {KIND: "float", "value": _not_finite(value)}
        if type(value) is complex:
            return {KIND: "complex", "parts": [self.encode(x, place) for x in (value.real, value.imag)]}
        if isinstance(value, np.generic) and value.dtype.kind in NUMBERS:
            return {KIND: "number", "type": value.dtype.str, "value": self.encode(value.item(), place)}
        if isinstance(value, np.ndarray | jax.Array):
            return self._array(value, place)
        if isinstance(value, type) and issubclass(value, Effect):
            return {KIND: "effect class", **self._name_of_effect(value)}
        if isinstance(value, Effect):
            return {KIND: "effect", **self._name_of_effect(type(value)), "fields": self._fields(value, place)}
        # Members of an enumeration are of one class, whatever the enumeration.
        if (enumeration := getattr(value, "_enumeration", None)) is not None:
            return {KIND: "outcome", "type": _path(enumeration), "name": _name_of_outcome(value)}
        if isinstance(value, ct.TransferFunction | ct.StateSpace):
            return self._system(value, place)
        if (isinstance(value, tuple) and hasattr(value, "_fields")) or dataclasses.is_dataclass(value):
            return self._record(value, place)
        if isinstance(value, Mapping):
            pairs = [[self.encode(k, place), self.encode(v, f"{place}[{k!r}]")] for k, v in value.items()]
            return {KIND: "mapping", "pairs": pairs}
        if isinstance(value, list):
            return [self.encode(x, f"{place}[{i}]") for i, x in enumerate(value)]
        if isinstance(value, tuple):
            return {KIND: "tuple", "items": [self.encode(x, f"{place}[{i}]") for i, x in enumerate(value)]}
        if isinstance(value, frozenset):
            return {KIND: "frozenset", "items": [self.encode(x, place) for x in sorted(value)]}
        raise ResultFileError(f"{place}: is a {type(value).__name__}, which a file of results does not hold.")

    def _record(self, value: Any, place: str) -> Any:
        path = _path(type(value))
        if path.partition(".")[0] not in self.packages:
            raise ResultFileError(
                f"{place}: is a {type(value).__name__} of {type(value).__module__}, which is not among the packages "
                f"{', '.join(self.packages)}; estimators.save keeps results of both."
            )
        return {KIND: "record", "type": path, "fields": self._fields(value, place)}

    def _fields(self, value: Any, place: str) -> dict[str, Any]:
        names = field_names(type(value))
        return {name: self.encode(getattr(value, name), f"{place}.{name}") for name in names}

    def _name_of_effect(self, effect: type[Effect]) -> dict[str, Any]:
        if CATALOGUE.get(effect.id) is effect:
            return {"id": effect.id}
        if issubclass(effect, FormulaForce) and effect.terms:  # made when it was read off, so that no name leads to it
            terms = [list(term) for term in effect.terms]
            return {"formula": [effect.port, effect.variable, terms, effect.slow]}
        if effect.__module__.partition(".")[0] in self.packages:
            return {"type": _path(effect)}
        return {"id": effect.id, "own": effect.__qualname__}

    def _array(self, value: Any, place: str) -> Any:
        if id(value) not in self._places:
            array = np.asarray(value)
            if array.dtype.kind not in NUMBERS:
                raise ResultFileError(f"{place}: is an array of {array.dtype}, and a file of results holds numbers.")
            self._places[id(value)] = len(self.arrays)
            self._kept.append(value)
            self.arrays.append(array)
        # Linear algebra rounds otherwise where the memory is laid out otherwise.
        array = self.arrays[self._places[id(value)]]
        by_columns = array.flags.f_contiguous and not array.flags.c_contiguous
        kind = "jax array" if isinstance(value, jax.Array) else "array"
        return {KIND: kind, "at": self._places[id(value)], "order": "F" if by_columns else "C"}

    def _system(self, value: Any, place: str) -> Any:
        labels = {"inputs": list(value.input_labels), "outputs": list(value.output_labels), "name": value.name}
        dt = {"dt": self.encode(value.dt, place)}
        if isinstance(value, ct.StateSpace):
            parts = {part: self._array(np.asarray(getattr(value, part)), place) for part in "ABCD"}
            return {KIND: "state space", **parts, **dt, "states": list(value.state_labels), **labels}
        parts = {
            part: [[self._array(np.asarray(polynomial), place) for polynomial in row] for row in getattr(value, part)]
            for part in ("num", "den")
        }
        return {KIND: "transfer function", **parts, **dt, **labels}


def field_names(record: Any) -> tuple[str, ...]:
    """Return the names of the fields from which a named tuple or a data class is made."""
    named = getattr(record, "_fields", None)
    return tuple(f.name for f in dataclasses.fields(record) if f.init) if named is None else tuple(named)


def _path(record: type) -> str:
    return f"{record.__module__}.{record.__qualname__}"


def _not_finite(value: float) -> str:
    return "nan" if math.isnan(value) else "inf" if value > 0 else "-inf"


def not_finite(name: str) -> float:
    """Return the float that a file names, as JSON has none that is not finite."""
    return _NOT_FINITE[name]


def outcomes(enumeration: Any) -> dict[str, Any]:
    """Return the outcomes of an enumeration by name."""
    return dict(enumeration._name_to_item)


def _name_of_outcome(item: Any) -> str:
    return next(name for name, one in outcomes(item._enumeration).items() if bool(one == item))
