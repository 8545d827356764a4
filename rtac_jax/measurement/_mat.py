"""Import from MATLAB files, version 5 and 7.3, with an explicit channel mapping."""

import os
from collections.abc import Iterable, Mapping

import h5py
import numpy as np
import scipy.io
from jaxtyping import Float64

from ._columns import ImportOptions, imported
from ._errors import RecordingError
from ._experiment import Experiment
from ._hdf5 import MOST_ELEMENTS, Budget, guarded, open_hdf5
from ._mat5 import Mat5

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
    # MATLAB writes version 7.3 as HDF5 behind a header of 512 bytes, which h5py looks past.
    arrays = _read_v73(path, names) if h5py.is_hdf5(path) else _read_older(path, names)
    return {name: _vector(name, array) for name, array in arrays.items()}


def _read_v73(path: str | os.PathLike[str], names: Iterable[str]) -> dict[str, np.ndarray]:
    budget = Budget(os.path.getsize(path))
    arrays = {}
    with open_hdf5(path) as file:
        for name in names:
            # MATLAB keeps what variables refer to under names with a #.
            there = [str(key) for key in file if not str(key).startswith("#")]
            if name not in there or not isinstance(file.get(name, getlink=True), h5py.HardLink):
                raise RecordingError(_absent(name, there))
            with guarded(name):
                dataset = file[name]
                stored = dataset.attrs.get("MATLAB_class", b"double")
                # MATLAB stores text and truth values as integers too; only this attribute tells them apart.
                label = stored.decode() if isinstance(stored, bytes) else str(stored)
            if label not in NUMERIC:
                raise RecordingError(
                    f"{name}: is a MATLAB {label}, but a numeric vector was expected; save it as double."
                )
            arrays[name] = budget.values(dataset)
    return arrays


def _read_older(path: str | os.PathLike[str], names: Iterable[str]) -> dict[str, np.ndarray]:
    with open(path, "rb") as stream:
        # A file of version 4 begins with a small integer, one of version 5 with text.
        start = stream.read(4)
    return _read_v4(path, names) if len(start) == 4 and 0 in start else _read_v5(path, names)


def _read_v5(path: str | os.PathLike[str], names: Iterable[str]) -> dict[str, np.ndarray]:
    file = Mat5(path)
    names = list(names)
    _check_listed(names, {name: (variable.shape, variable.label) for name, variable in file.variables.items()})
    return {name: file.values(file.variables[name]) for name in names}


def _read_v4(path: str | os.PathLike[str], names: Iterable[str]) -> dict[str, np.ndarray]:
    names = list(names)
    try:
        listed = {name: (shape, label) for name, shape, label in scipy.io.whosmat(path)}
    except Exception as error:
        # SciPy passes on whatever its parser stumbles over: ValueError, TypeError, OSError and others.
        raise RecordingError("this is not a MAT file, or it is damaged; save it again with save -v7.") from error
    _check_listed(names, listed)
    try:
        loaded = scipy.io.loadmat(path, variable_names=names)
    except Exception as error:
        raise RecordingError("the MAT file is damaged or not complete; copy or save it again.") from error
    return {name: loaded[name] for name in names}


def _check_listed(names: Iterable[str], listed: Mapping[str, tuple[tuple[int, ...], str]]) -> None:
    for name in names:
        if name not in listed:
            raise RecordingError(_absent(name, listed))
        shape, label = listed[name]
        if label not in NUMERIC:
            raise RecordingError(f"{name}: is a MATLAB {label}, but a numeric vector was expected; save it as double.")
        if np.prod([float(length) for length in shape]) > MOST_ELEMENTS:
            raise RecordingError(
                f"{name}: declares the shape {shape}, more than {MOST_ELEMENTS} values; save it in parts."
            )


def _absent(name: str, there: Iterable[str]) -> str:
    return (
        f"{name}: there is no such variable; the file has {', '.join(one[:LONGEST_NAME] for one in there) or 'none'}."
    )


def _vector(name: str, array: np.ndarray) -> Float64[np.ndarray, " sample"]:
    # A vector has one row or one column in MATLAB; anything else would need a guess about its axes.
    if array.dtype.kind not in "fiu":
        raise RecordingError(f"{name}: the type is {array.dtype}, but real numbers were expected; save them as double.")
    if max(array.shape, default=0) != array.size:
        raise RecordingError(
            f"{name}: the shape is {array.shape}, but a vector was expected; save each column by itself."
        )
    return array.reshape(-1).astype(np.float64)
