"""Decoding of what `_encoding` wrote: records of named packages, through their constructors, and nothing else."""

import dataclasses
import importlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import control as ct
import equinox as eqx
import jax.numpy as jnp
import numpy as np

from rtac_jax._rigid_body import RigidBody
from rtac_jax.configuration import require_configured
from rtac_jax.effects import CATALOGUE, Effect
from rtac_jax.effects.formula_force import Term, formula_class
from rtac_jax.storage._encoding import KIND, field_names, not_finite, outcomes
from rtac_jax.storage._errors import ResultFileError

MOVED: Mapping[str, str] = {
    f"estimators.inference.hausman.{name}": f"estimators.inference.agreement.{name}"
    for name in ("Agreement", "Disagreement")
} | {"estimators.diagnosis.improve.Improvement": "estimators.diagnosis.improvement.Improvement"}
"""Where records stand today that files of this version name by an older path."""

RENAMED: Mapping[tuple[str, str], str] = {
    ("Envelope", "gaps"): "model_errors",
    ("Trend", "share"): "fraction",
    ("Improvement", "foreseen"): "predicted_gains",
}
"""What fields of records are called today, by class and the name that older files of this version give."""


def _state_space(value: Any, decode: Callable[[Any], Any]) -> ct.StateSpace:
    parts = (decode(value[part]) for part in "ABCD")
    return ct.StateSpace(
        *parts, decode(value["dt"]), remove_useless_states=False, states=value["states"],
        inputs=value["inputs"], outputs=value["outputs"], name=value["name"],
    )  # fmt: skip


def _transfer_function(value: Any, decode: Callable[[Any], Any]) -> ct.TransferFunction:
    return ct.TransferFunction(
        decode(value["num"]), decode(value["den"]), decode(value["dt"]), inputs=value["inputs"],
        outputs=value["outputs"], name=value["name"],
    )  # fmt: skip


_VALUES: Mapping[str, Callable[[Any, Callable[[Any], Any]], Any]] = {
    "float": lambda value, _: not_finite(value["value"]),
    "complex": lambda value, decode: complex(*(decode(x) for x in value["parts"])),
    "number": lambda value, decode: np.dtype(value["type"]).type(decode(value["value"])),
    "tuple": lambda value, decode: tuple(decode(x) for x in value["items"]),
    "frozenset": lambda value, decode: frozenset(decode(x) for x in value["items"]),
    "mapping": lambda value, decode: {decode(k): decode(v) for k, v in value["pairs"]},
    "state space": _state_space,
    "transfer function": _transfer_function,
}
# What is decoded by methods, as it needs arrays of the file, or asks who may make it.
_RECORDS = ("array", "jax array", "record", "effect", "effect class", "outcome")


class Decoder:
    """Decodes one result.

    Args:
        array: returns an array of the file by its number.
        packages: whose records may be in the file.
        effects: classes of the user's own effects.
        written_by: the version of the package that wrote the file, for refusals.
    """

    def __init__(
        self,
        array: Callable[[int], np.ndarray],
        packages: tuple[str, ...],
        effects: Sequence[type[Effect]],
        written_by: str,
    ) -> None:
        self.array, self.packages, self.written_by = array, packages, written_by
        self.own = {effect.id: effect for effect in effects}
        self._arrays: dict[tuple[int, str, str], Any] = {}

    def decode(self, value: Any) -> Any:
        """Return the value that a JSON value stands for.

        Raises:
            ResultFileError: it names a record, a field or an effect that is not there.
        """
        if isinstance(value, list):
            return [self.decode(x) for x in value]
        if not isinstance(value, dict):
            return value
        kind = value[KIND]
        if kind in _VALUES:
            return _VALUES[kind](value, self.decode)
        if kind not in _RECORDS:
            raise ResultFileError(f"holds a {kind}, which this version does not know{self._other}.")
        return getattr(self, f"_{kind.replace(' ', '_')}")(value)

    @property
    def _other(self) -> str:
        return f"; it was written by rtac-jax {self.written_by}, so use that version, or make the result again"

    def _array(self, value: Any) -> np.ndarray:
        key = (value["at"], value[KIND], value["order"])
        if key not in self._arrays:
            self._arrays[key] = np.require(self.array(value["at"]), requirements="F" if value["order"] == "F" else "C")
        return self._arrays[key]

    def _jax_array(self, value: Any) -> Any:
        require_configured()  # or double precision would be lost unseen
        key = (value["at"], value[KIND], value["order"])
        if key not in self._arrays:
            self._arrays[key] = jnp.asarray(self.array(value["at"]))
        return self._arrays[key]

    def _effect_class(self, value: Any) -> type[Effect]:
        if "formula" in value:
            port, variable, terms, slow = value["formula"]
            return formula_class(port, variable, tuple(Term(kind, number) for kind, number in terms), slow)
        if "type" in value:
            return self._class(value["type"])
        if "own" not in value:
            if value["id"] not in CATALOGUE:
                raise ResultFileError(f"holds the effect {value['id']}, which is not in the catalogue{self._other}.")
            return CATALOGUE[value["id"]]
        if value["id"] not in self.own:
            raise ResultFileError(
                f"holds the effect {value['id']} of your own, of the class {value['own']}; give it when loading: "
                f"effects=[{value['own']}] in Python, --effects FILE.py on the command line."
            )
        return self.own[value["id"]]

    def _effect(self, value: Any) -> Effect:
        return self._made(self._effect_class(value), value["fields"])

    def _outcome(self, value: Any) -> Any:
        enumeration = self._class(value["type"])
        known = outcomes(enumeration)
        if value["name"] not in known:
            raise ResultFileError(f"holds the outcome {value['name']}, which this version does not know{self._other}.")
        return known[value["name"]]

    def _record(self, value: Any) -> Any:
        return self._made(self._class(value["type"]), value["fields"])

    def _class(self, path: str) -> Any:
        path = MOVED.get(path, path)
        module, _, name = path.rpartition(".")
        package = path.partition(".")[0]
        if package not in self.packages:
            raise ResultFileError(f"holds a {name} of the package {package}; load it with {package}.load.")
        try:
            found = getattr(importlib.import_module(module), name)
        except (ImportError, AttributeError, ValueError) as error:
            raise ResultFileError(f"holds a {path}, which this version does not have{self._other}.") from error
        # Only what is made of fields, or an enumeration, is made from a file; no function is ever called.
        allowed = isinstance(found, type) and (
            dataclasses.is_dataclass(found) or hasattr(found, "_fields") or issubclass(found, eqx.Enumeration)
        )
        if not allowed or found.__module__ != module:
            raise ResultFileError(f"names {path}, which is no record of results; the file is not of rtac-jax.")
        return found

    def _made(self, record: Any, fields: Mapping[str, Any]) -> Any:
        known = field_names(record)
        fields = {RENAMED.get((record.__name__, name), name): value for name, value in fields.items()}
        unknown = [name for name in fields if name not in known]
        if unknown:
            raise ResultFileError(
                f"holds a {record.__name__} with {', '.join(unknown)}, which it does not have here{self._other}."
            )
        decoded = {name: self.decode(value) for name, value in fields.items()}
        try:
            return record.as_fitted(**decoded) if record is RigidBody else record(**decoded)
        except (TypeError, ValueError, ArithmeticError) as error:
            raise ResultFileError(
                f"holds a {record.__name__} that cannot be made here ({error}){self._other}."
            ) from error
