"""The file of a result: HDF5 behind 512 bytes that name format, version and checksum.

The first line of a file reads `rtac-result VERSION SHA-256`. The checksum is that of everything behind the 512 bytes and is
verified before anything is read. There stand, in HDF5, which looks past such a block by itself: the attributes `format`,
`version`, `written_by` and `holds` (the name of the record), the data set `record` (JSON, UTF-8), and the group `arrays` with
the arrays of the record, numbered.
"""

import hashlib
import importlib.metadata
import io
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from rtac_jax.effects import Effect
from rtac_jax.measurement.atomic_write import replacing
from rtac_jax.storage._decoding import Decoder
from rtac_jax.storage._encoding import Encoder
from rtac_jax.storage._errors import ResultFileError

FORMAT, VERSION = "rtac-result", 1
ENDINGS = (".h5", ".hdf5")
PACKAGES = ("rtac_jax",)
_BLOCK = 512  # bytes, the least that HDF5 leaves free for others
_LARGE = 2048  # bytes, from which on an array is compressed
_EXPANSION, _SLACK = 1100, 1 << 20  # deflate makes at most 1032 bytes of one
_DAMAGED = "the file is damaged or not complete; copy it again, or make the result again."


def save(result: object, path: str | os.PathLike[str], *, packages: tuple[str, ...] = PACKAGES) -> None:
    """Write a model or a result to a file, from which `load` returns the same, bit for bit.

    A file that was there is replaced only when the new one is complete.

    Args:
        result: a record of frozen fields, such as a model or a fit.
        path: of the file, ending in ".h5" or ".hdf5".
        packages: whose records may be in it.

    Raises:
        ResultFileError: another ending, or something inside that a file does not hold.
        FileNotFoundError: there is no such folder.
        OSError: it cannot be written.
    """
    if Path(path).suffix.lower() not in ENDINGS:
        raise ResultFileError(f"{os.fspath(path)}: cannot be written; let the name end in {' or '.join(ENDINGS)}.")
    encoder = Encoder(packages)
    record = json.dumps(encoder.encode(result, type(result).__name__), allow_nan=False, separators=(",", ":")).encode()
    # In memory first: when the disk is full, HDF5 fails again on every attempt to close, and can end the process.
    content = io.BytesIO()
    with h5py.File(content, "w", libver=("v108", "v108"), userblock_size=_BLOCK) as file:
        file.attrs.update(format=FORMAT, version=VERSION, holds=type(result).__name__)
        file.attrs["written_by"] = importlib.metadata.version("rtac-jax")
        _write(file, "record", np.frombuffer(record, dtype=np.uint8))
        group = file.create_group("arrays")
        for number, array in enumerate(encoder.arrays):
            _write(group, str(number), array)
    whole = content.getbuffer()
    whole[:_BLOCK] = f"{FORMAT} {VERSION} {hashlib.sha256(whole[_BLOCK:]).hexdigest()}\n".encode().ljust(_BLOCK, b"\0")
    with replacing(path) as temporary:
        temporary.write_bytes(whole)


def load(
    path: str | os.PathLike[str], *, effects: Sequence[type[Effect]] = (), packages: tuple[str, ...] = PACKAGES
) -> Any:
    """Return the model or result that `save` wrote.

    Args:
        path: of the file.
        effects: classes of the user's own effects that may be in it; those of the catalogue are known.
        packages: whose records may be in it.

    Raises:
        FileNotFoundError: there is no such file.
        ResultFileError: it is no file of results, damaged, of another version, or holds an effect that is not there.
        RuntimeError: JAX was not configured for double precision.
    """
    try:
        return _load(path, effects, packages)
    except ResultFileError as error:
        raise ResultFileError(f"{os.fspath(path)}: {error}") from error.__cause__


def is_result_file(path: str | os.PathLike[str]) -> bool:
    """Return whether a file says that it holds a result, of whatever version."""
    try:
        with open(path, "rb") as stream:
            return stream.read(len(FORMAT) + 1) == f"{FORMAT} ".encode()
    except OSError:
        return False


def _load(path: str | os.PathLike[str], effects: Sequence[type[Effect]], packages: tuple[str, ...]) -> Any:
    if not os.path.exists(path):
        raise FileNotFoundError(f"{os.fspath(path)}: there is no such file; check the path.")
    try:
        whole = Path(path).read_bytes()
    except OSError as error:
        raise ResultFileError(f"cannot be read ({error.strerror}); name a file of results.") from error
    name, version, checksum = (*whole[:_BLOCK].split(b"\n")[0].split(b" "), b"", b"")[:3]
    if name != FORMAT.encode():
        raise ResultFileError(
            "holds no model or result; those are written by save. A recording is loaded with Recording.load."
        )
    if version != str(VERSION).encode():
        raise ResultFileError(
            f"is of version {version.decode(errors='replace')} of its format, and this rtac-jax reads version {VERSION}; "
            "use the rtac-jax that wrote it, or make the result again."
        )
    if hashlib.sha256(whole[_BLOCK:]).hexdigest().encode() != checksum:
        raise ResultFileError(f"does not agree with its checksum: {_DAMAGED}")
    try:
        with h5py.File(io.BytesIO(whole), "r") as file:
            record = json.loads(_read(file, "record", len(whole)).tobytes())
            group = file["arrays"]
            read = [_read(group, str(number), len(whole)) for number in range(len(group))]
            written_by = str(file.attrs["written_by"])
        return Decoder(lambda number: read[number], packages, effects, written_by).decode(record)
    except (ResultFileError, RuntimeError):
        raise
    except Exception as error:  # of HDF5, JSON or Python, when a file with a right checksum was made by another hand
        raise ResultFileError(f"could not be read ({type(error).__name__}): {_DAMAGED}") from error


def _write(group: h5py.Group, name: str, array: np.ndarray) -> None:
    options = {"compression": "gzip", "compression_opts": 4, "shuffle": True} if array.nbytes > _LARGE else {}
    group.create_dataset(name, data=array, **options)


def _read(group: h5py.Group, name: str, size: int) -> np.ndarray:
    link, dataset = group.get(name, getlink=True), group[name]
    if not isinstance(link, h5py.HardLink) or not isinstance(dataset, h5py.Dataset):
        raise ResultFileError(f"/{name} is no data set of the file itself: {_DAMAGED}")
    if dataset.external or dataset.is_virtual or dataset.dtype.kind not in "biufc":
        raise ResultFileError(f"{dataset.name} holds no numbers of its own: {_DAMAGED}")
    if dataset.size * dataset.dtype.itemsize > _EXPANSION * size + _SLACK:
        raise ResultFileError(f"{dataset.name} declares more than the file can hold: {_DAMAGED}")
    return dataset[()] if dataset.shape else np.asarray(dataset[()])
