"""Addresses inside MATLAB variables: fields of structures and columns of matrices, written as in MATLAB."""

import re
from typing import NamedTuple

import numpy as np

from ._errors import RecordingError

_FIELD = re.compile(r"^(?P<name>[A-Za-z]\w*)(?:\((?P<number>[1-9]\d{0,6})\))?$")
_ADDRESS = re.compile(
    r"^(?P<path>[A-Za-z][^:,]*?)(?:\(\s*:\s*,\s*(?P<column>[1-9]\d{0,6})\s*\)|\(\s*(?P<row>[1-9]\d{0,6})\s*,\s*:\s*\))?$"
)


class Field(NamedTuple):
    """One name of an address: of a variable or a field, and which element of a structure array it is, from 0."""

    name: str
    number: int

    def __str__(self) -> str:
        return self.name + (f"({self.number + 1})" if self.number else "")


class Address(NamedTuple):
    """The place of a vector in a MAT file, as `scope.signals(2).values`, `log(:,3)` or `ans(2,:)`.

    Attributes:
        fields: the variable and the fields below it.
        axis: 1 for a column, 0 for a row of a matrix; None where the whole is a vector.
        place: of the column or row, from 0.
    """

    fields: tuple[Field, ...]
    axis: int | None = None
    place: int = 0

    @classmethod
    def of(cls, text: str) -> "Address":
        """Return the address that a text states; one that is none is a variable of that name."""
        match = _ADDRESS.match(text.strip())
        steps = [] if match is None else [_FIELD.match(step) for step in match["path"].strip().split(".")]
        fields = tuple(Field(step["name"], int(step["number"] or 1) - 1) for step in steps if step is not None)
        # An element of a structure array has fields; of one number of a vector nobody asks.
        last = next(reversed(steps), None)
        if match is None or len(fields) < len(steps) or (last is not None and last["number"]):
            return cls((Field(text, 0),))
        if match["column"]:
            return cls(fields, 1, int(match["column"]) - 1)
        return cls(fields, 0, int(match["row"]) - 1) if match["row"] else cls(fields)

    @property
    def variable(self) -> str:
        """Return the name of the variable."""
        return self.fields[0].name

    def vector(self, text: str, array: np.ndarray) -> np.ndarray:
        """Return what the address takes of an array.

        Args:
            text: the address, for the sentence.
            array: in MATLAB's order of axes.

        Raises:
            RecordingError: the array has no such column or row, or is no vector.
        """
        if array.dtype.kind not in "fiu":
            raise RecordingError(
                f"{text}: the type is {array.dtype}, but real numbers were expected; save them as double."
            )
        if self.axis is not None:
            what = ("rows", "columns")[self.axis]
            if array.ndim != 2 or self.place >= array.shape[self.axis]:
                raise RecordingError(f"{text}: the shape is {array.shape}; name one of its {what}, counted from 1.")
            array = array.take(self.place, axis=self.axis)
        # A vector has one row or one column in MATLAB; anything else would need a guess about its axes.
        if max(array.shape, default=0) != array.size:
            raise RecordingError(
                f"{text}: the shape is {array.shape}, but a vector was expected; name a column as {text}(:,1), or a row as"
                f" {text}(1,:)."
            )
        return array.reshape(-1).astype(np.float64)
