"""Numbers in variables and structures of MAT files of version 5, read with nothing but bounds-checked slices.

SciPy's reader trusts the tags of a file: a damaged one can end the process. Of the format (MathWorks, "MAT-File Level 5
File Format") this reads what a recording needs, and names the rest.
"""

import math
import os
import struct
import zlib
from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np

from ._errors import RecordingError
from ._hdf5 import MOST_EXPANSION, SLACK_BYTES

Order = Literal["<", ">"]

HEADER_BYTES = 128
VERSION = 0x0100
# Types of data elements.
INT8, INT32, UINT32, MATRIX, COMPRESSED = 1, 5, 6, 14, 15
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
# Array classes; those with a type hold numbers.
CLASSES = {1: "cell", 2: "struct", 3: "object", 4: "char", 5: "sparse", 16: "function", 17: "object"}
OPAQUE = 17  # as a timeseries or a table; it states no shape
NUMERIC = {
    6: ("double", "f8"), 7: ("single", "f4"), 8: ("int8", "i1"), 9: ("uint8", "u1"), 10: ("int16", "i2"),
    11: ("uint16", "u2"), 12: ("int32", "i4"), 13: ("uint32", "u4"), 14: ("int64", "i8"), 15: ("uint64", "u8"),
}  # fmt: skip
COMPLEX, LOGICAL = 0x0800, 0x0200
# Enough of a compressed variable for its class, shape and name, which MATLAB keeps below 64 characters.
HEAD_BYTES = 1024


class Damaged(Exception):
    """The bytes are not those of a MAT file."""


class Variable(NamedTuple):
    """A variable as its head declares it.

    Attributes:
        name: of the variable.
        label: its MATLAB class.
        shape: of the array.
        complex: whether an imaginary part follows.
        dtype: of the numbers; "" for a class that holds none.
        body: of the whole element, compressed or not.
        packed: whether `body` is compressed.
        at: where the real part begins in the element.
    """

    name: str
    label: str
    shape: tuple[int, ...]
    complex: bool
    dtype: str
    body: memoryview
    packed: bool
    at: int


_EMPTY = Variable("", "empty array", (0, 0), complex=False, dtype="", body=memoryview(b""), packed=False, at=0)


class Mat5:
    """The variables of a file, by name; the samples are read on demand.

    Raises:
        RecordingError: the file is no MAT file of version 5, or is damaged.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        with open(path, "rb") as stream:
            content = memoryview(stream.read())
        try:
            self._order: Order = _byte_order(content)
            heads = [self._head(kind, body) for kind, body in self._elements(content)]
            self.variables = {head.name: head for head in heads if head is not None and head.name}
        except (Damaged, zlib.error) as error:
            raise RecordingError("this is not a MAT file, or it is damaged; save it again with save -v7.") from error

    def values(self, variable: Variable) -> np.ndarray:
        """Return the numbers of a variable, in its shape and class.

        Raises:
            RecordingError: there are fewer or more of them than the shape declares, or they are damaged.
        """
        # Stored in at most eight bytes each; what a hostile file unpacks to beyond that is not looked at.
        most = 2 * 8 * math.prod(variable.shape) + HEAD_BYTES
        try:
            body = _unpacked(variable.body, most, whole=True) if variable.packed else variable.body
            real, after = self._numbers(body, variable.at, variable)
            if variable.complex:
                real = real + 1j * self._numbers(body, after, variable)[0]
        except (Damaged, zlib.error) as error:
            raise RecordingError(
                f"{variable.name}: the MAT file is damaged or not complete there; copy or save it again."
            ) from error
        return real.reshape(variable.shape, order="F")

    def names(self, variable: Variable) -> list[str]:
        """Return the names of the fields of a structure that has one element or more; none of what is no structure."""
        if variable.label != "struct" or not math.prod(variable.shape):
            return []
        return list(self.fields(variable, 0))

    def fields(self, variable: Variable, number: int) -> dict[str, Variable]:
        """Return the fields of one element of a structure, or of a structure array.

        Args:
            variable: that holds it.
            number: of the element, from 0; there is one of it.

        Raises:
            RecordingError: the structure is damaged.
        """
        try:
            most = MOST_EXPANSION * len(variable.body) + SLACK_BYTES
            body = _unpacked(variable.body, most, whole=True) if variable.packed else variable.body
            width, at = self._element(body, variable.at, INT32)
            (length,) = self._unpack("i", width, 0)
            listed, at = self._element(body, at, INT8)
            if length < 1 or len(listed) % length:
                raise Damaged("names of fields of another length than is declared")
            names = [_text(listed[begin : begin + length]) for begin in range(0, len(listed), length)]
            found: dict[str, Variable] = {}
            for place in range((number + 1) * len(names)):
                kind, element, at = self._any_element(body, at)
                if kind != MATRIX:
                    raise Damaged("a field is no variable")
                if place >= number * len(names):
                    name = names[place % len(names)]
                    head = self._head(kind, element)
                    found[name] = (_EMPTY if head is None else head)._replace(name=name)
        except (Damaged, zlib.error) as error:
            raise RecordingError(
                f"{variable.name}: the MAT file is damaged or not complete there; copy or save it again."
            ) from error
        return found

    def _elements(self, content: memoryview) -> Iterator[tuple[int, memoryview]]:
        at = HEADER_BYTES
        while at < len(content):
            kind, length = self._unpack("II", content, at)
            if at + 8 + length > len(content):
                raise Damaged("an element goes beyond the end")
            yield kind, content[at + 8 : at + 8 + length]
            at += 8 + length

    def _head(self, kind: int, body: memoryview) -> Variable | None:
        packed = kind == COMPRESSED
        element = body
        if packed:
            element = _unpacked(body, HEAD_BYTES)
            kind, _ = self._unpack("II", element, 0)
            element = element[8:]
        if kind != MATRIX:
            raise Damaged("an element is no variable")
        if not len(element):
            return None
        flags, after = self._element(element, 0, UINT32)
        if len(flags) == 8 and self._unpack("II", flags, 0)[0] & 0xFF == OPAQUE:
            name, _ = self._element(element, after, INT8)
            return Variable(
                _text(name), CLASSES[OPAQUE], (1, 1), complex=False, dtype="", body=body, packed=packed, at=0
            )
        shape, after = self._element(element, after, INT32)
        name, after = self._element(element, after, INT8)
        if len(flags) != 8 or len(shape) < 8 or len(shape) % 4:
            raise Damaged("no flags or no shape")
        (word, _) = self._unpack("II", flags, 0)
        dimensions = self._unpack(f"{len(shape) // 4}i", shape, 0)
        number = word & 0xFF
        if min(dimensions) < 0 or not (number in CLASSES or number in NUMERIC):
            raise Damaged("a shape or class that does not exist")
        label, dtype = NUMERIC.get(number, (CLASSES.get(number, ""), ""))
        label = "logical" if word & LOGICAL else label
        # Where the samples begin in the whole element, of which 8 bytes of tag come first when it was packed.
        at = after + (8 if packed else 0)
        return Variable(_text(name), label, dimensions, bool(word & COMPLEX), dtype, body, packed, at)

    def _element(self, content: memoryview, at: int, expected: int | None = None) -> tuple[memoryview, int]:
        """Return an element's bytes, and where the next one begins."""
        kind, data, after = self._any_element(content, at)
        if kind != expected:
            raise Damaged("another kind of element was expected")
        return data, after

    def _any_element(self, content: memoryview, at: int) -> tuple[int, memoryview, int]:
        kind, length = self._unpack("II", content, at)
        if kind >> 16:  # the short form: at most four bytes, in the tag itself
            kind, length, begin, after = kind & 0xFFFF, kind >> 16, at + 4, at + 8
            if length > 4:
                raise Damaged("a short element of more than four bytes")
        else:
            begin = at + 8
            after = begin + -(-length // 8) * 8
        if begin + length > len(content):
            raise Damaged("an element goes beyond the end")
        return kind, content[begin : begin + length], after

    def _numbers(self, content: memoryview, at: int, variable: Variable) -> tuple[np.ndarray, int]:
        kind, data, after = self._any_element(content, at)
        stored = NUMBERS.get(kind)
        if stored is not None and stored != variable.dtype:
            # Whole numbers may be stored in fewer bytes than their class has; nothing else is ever stored in another type.
            shorter = np.dtype(stored).itemsize < np.dtype(variable.dtype).itemsize
            if not shorter or np.dtype(stored).kind == "f":
                raise Damaged("numbers of another type than their class has")
        if stored is None or len(data) != math.prod(variable.shape) * np.dtype(stored).itemsize:
            raise Damaged("not as many numbers as the shape declares")
        return np.frombuffer(data, dtype=np.dtype(stored).newbyteorder(self._order)).astype(variable.dtype), after

    def _unpack(self, form: str, content: memoryview, at: int) -> tuple[int, ...]:
        size = struct.calcsize(self._order + form)
        if at + size > len(content):
            raise Damaged("the file ends too early")
        return struct.unpack(self._order + form, content[at : at + size])


def _byte_order(content: memoryview) -> Order:
    orders: dict[bytes, Order] = {b"IM": "<", b"MI": ">"}
    order = orders.get(bytes(content[126:HEADER_BYTES]))
    if order is None or struct.unpack(f"{order}H", content[124:126])[0] != VERSION:
        raise Damaged("no header of version 5")
    return order


def _text(name: memoryview) -> str:
    try:
        return bytes(name).decode("ascii").strip("\0")
    except UnicodeDecodeError as error:
        raise Damaged("a name that is no text") from error


def _unpacked(body: memoryview, most: int, whole: bool = False) -> memoryview:
    """Return at most so many bytes of a compressed element; with its checksum, where all of it is asked for."""
    unpacker = zlib.decompressobj()
    result = unpacker.decompress(body, most)
    if whole and not unpacker.eof:
        raise Damaged("an element is cut off, or longer than it declares")
    return memoryview(result)
