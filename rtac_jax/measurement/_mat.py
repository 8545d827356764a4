"""Import from MATLAB files, version 5 and 7.3, with an explicit channel mapping: vectors, fields of structures, columns."""

import math
import os
from collections.abc import Iterable, Mapping
from typing import Any

import h5py
import numpy as np
import scipy.io
from jaxtyping import Float64

from ._columns import ImportOptions, imported
from ._errors import RecordingError
from ._experiment import Experiment
from ._hdf5 import MOST_ELEMENTS, Budget, guarded, open_hdf5
from ._mat5 import Mat5, Variable
from ._mat_address import Address, Field

LONGEST_NAME = 63  # characters of a name in MATLAB; a damaged file may declare longer ones
NUMERIC = ("double", "single", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64")


def read(
    path: str | os.PathLike[str], channels: Mapping[str, str], kind: str, options: ImportOptions
) -> tuple[Experiment, Mapping[str, float]]:
    """Return the experiment in a MAT file, and the constants of its rig; see `Recording.from_mat`."""
    return imported(path, lambda names: _read_vectors(path, names), channels, kind, options)


def _read_vectors(path: str | os.PathLike[str], names: Iterable[str]) -> dict[str, Float64[np.ndarray, " sample"]]:
    if not os.path.exists(path):
        raise FileNotFoundError(f"{os.fspath(path)}: there is no such file; check the path.")
    if not os.path.isfile(path):
        raise RecordingError("this is not a file; give the path of a MAT file.")
    addresses = {name: Address.of(name) for name in names}
    # MATLAB writes version 7.3 as HDF5 behind a header of 512 bytes, which h5py looks past.
    arrays = _read_v73(path, addresses) if h5py.is_hdf5(path) else _read_older(path, addresses)
    return {name: addresses[name].vector(name, array) for name, array in arrays.items()}


def _read_v73(path: str | os.PathLike[str], addresses: Mapping[str, Address]) -> dict[str, np.ndarray]:
    budget = Budget(os.path.getsize(path))
    arrays = {}
    with open_hdf5(path) as file:
        for name, address in addresses.items():
            there: Any = file
            for depth, field in enumerate(address.fields):
                there = _stored(there, field.name, address.fields[depth - 1] if depth else None, name, file)
            label = _matlab_class(there, name)
            if label not in NUMERIC:
                raise RecordingError(_not_numeric(name, label, _listed(there)))
            # HDF5 holds MATLAB's columns as rows.
            arrays[name] = np.transpose(budget.values(there))
    return arrays


def _stored(parent: Any, key: str, structure: Field | None, name: str, file: h5py.File) -> Any:
    """Return what a file of version 7.3 holds under a name.

    Args:
        parent: the file, or the group of a structure.
        key: the name there.
        structure: which element of the structure is meant; None for the file.
        name: the whole address, for the sentence.
        file: that the references of a structure array are of.

    Raises:
        RecordingError: there is no such name or element, or it is kept in another file.
    """
    listed = _listed(parent)
    with guarded(name):
        hard = key in listed and isinstance(parent.get(key, getlink=True), h5py.HardLink)
    if not hard:
        raise RecordingError(_absent(name, key, listed, whole=structure is None))
    with guarded(name):
        found = parent[key]
        # A field of a structure array is a list of references, one for each element.
        several = isinstance(found, h5py.Dataset) and h5py.check_ref_dtype(found.dtype) is h5py.Reference
        several = several and "MATLAB_class" not in found.attrs  # a cell array is one of references too
        count = int(found.size) if several else 1
        if structure is None or (structure.number < count and not several):
            return found
        if structure.number < count <= MOST_ELEMENTS:
            return file[found[()].reshape(-1)[structure.number]]
    raise RecordingError(_no_element(name, structure.name, count))


def _listed(group: object) -> list[str]:
    # MATLAB keeps what variables refer to under names with a #.
    return [str(key) for key in group if not str(key).startswith("#")] if isinstance(group, h5py.Group) else []


def _matlab_class(there: Any, name: str) -> str:
    with guarded(name):
        stored = there.attrs.get("MATLAB_class", b"struct" if isinstance(there, h5py.Group) else b"double")
        # MATLAB stores text and truth values as integers too; only this attribute tells them apart.
        return stored.decode() if isinstance(stored, bytes) else str(stored)


def _read_older(path: str | os.PathLike[str], addresses: Mapping[str, Address]) -> dict[str, np.ndarray]:
    with open(path, "rb") as stream:
        # A file of version 4 begins with a small integer, one of version 5 with text.
        start = stream.read(4)
    return _read_v4(path, addresses) if len(start) == 4 and 0 in start else _read_v5(path, addresses)


def _read_v5(path: str | os.PathLike[str], addresses: Mapping[str, Address]) -> dict[str, np.ndarray]:
    file = Mat5(path)
    found: dict[str, Variable] = {}
    for name, address in addresses.items():
        among = file.variables
        for depth, field in enumerate(address.fields):
            if depth:
                structure, before = found[name], address.fields[depth - 1]
                if structure.label == "struct" and before.number >= (count := math.prod(structure.shape)):
                    raise RecordingError(_no_element(name, before.name, count))
                among = file.fields(structure, before.number) if structure.label == "struct" else {}
            if field.name not in among:
                raise RecordingError(_absent(name, field.name, among, whole=not depth))
            found[name] = among[field.name]
        _check_numeric(name, found[name].shape, found[name].label, file.names(found[name]))
    return {name: file.values(variable) for name, variable in found.items()}


def _read_v4(path: str | os.PathLike[str], addresses: Mapping[str, Address]) -> dict[str, np.ndarray]:
    try:
        listed = {name: (shape, label) for name, shape, label in scipy.io.whosmat(path)}
    except Exception as error:
        # SciPy passes on whatever its parser stumbles over: ValueError, TypeError, OSError and others.
        raise RecordingError("this is not a MAT file, or it is damaged; save it again with save -v7.") from error
    for name, address in addresses.items():
        if address.variable not in listed:
            raise RecordingError(_absent(name, address.variable, listed, whole=True))
        if len(address.fields) > 1:
            raise RecordingError(_absent(name, address.fields[1].name, (), whole=False))
        _check_numeric(name, *listed[address.variable], ())
    try:
        loaded = scipy.io.loadmat(path, variable_names=[address.variable for address in addresses.values()])
    except Exception as error:
        raise RecordingError("the MAT file is damaged or not complete; copy or save it again.") from error
    return {name: loaded[address.variable] for name, address in addresses.items()}


def _check_numeric(name: str, shape: tuple[int, ...], label: str, fields: Iterable[str]) -> None:
    if label not in NUMERIC:
        raise RecordingError(_not_numeric(name, label, fields))
    if np.prod([float(length) for length in shape]) > MOST_ELEMENTS:
        raise RecordingError(f"{name}: declares the shape {shape}, more than {MOST_ELEMENTS} values; save it in parts.")


def _not_numeric(name: str, label: str, fields: Iterable[str]) -> str:
    known = [field[:LONGEST_NAME] for field in fields]
    mend = "save what it holds as vectors, as x = " + name + ".Data" if label == "object" else "save it as double"
    if known:
        mend = f"name one of its fields, {', '.join(f'{name}.{field}' for field in known)}"
    return f"{name}: is a MATLAB {label}, but a numeric vector was expected; {mend}."


def _no_element(name: str, structure: str, count: int) -> str:
    return f"{name}: {structure} has {count} elements; name one of them, as {structure}(1)."


def _absent(name: str, key: str, there: Iterable[str], *, whole: bool) -> str:
    known = ", ".join(one[:LONGEST_NAME] for one in there)
    if whole:
        return f"{name}: there is no such variable; the file has {known or 'none'}."
    if not known:
        return f"{name}: {key} is no field, as what it is asked of is no structure; name the variable alone."
    return f"{name}: there is no field {key}; there are {known}."
