"""Finished chunks of a study as HDF5 files, one for each, which appear only when they are complete."""

import contextlib
import io
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from estimators.study.layout import Arrays, Layout
from rtac_jax.measurement.atomic_write import replacing

_FORMAT = "rtac-study"
_VERSION = 1
_DESCRIPTION = "study.toml"
_CHUNKS = "chunks"
_LOCK = "lock"


class StorageError(ValueError):
    """A folder whose results do not belong to the study, are damaged, or are in use; the message says what to do."""


class Storage:
    """The folder of one study.

    A chunk is made in memory, written aside, brought to the disk and renamed, so that a file with a chunk's name is whole
    whatever ends the process. What is left is found from the files that are there.

    Args:
        folder: of the study.
        digest: of the study; results of another are refused.
        layout: of its variables.
    """

    def __init__(self, folder: str | os.PathLike[str], digest: str, layout: Layout) -> None:
        self.folder, self.digest, self.layout = Path(folder), digest, layout
        self._chunks = self.folder / _CHUNKS

    def begin(self, description: str) -> None:
        """Make the folder, or see that it is this study's.

        Args:
            description: text that tells what is computed, kept beside the results.

        Raises:
            StorageError: the folder holds results of another study.
            OSError: the folder cannot be written to.
        """
        self._chunks.mkdir(parents=True, exist_ok=True)
        files = self._files()
        if files and (other := _attributes(files[0])["digest"]) != self.digest:
            raise StorageError(
                f"{self.folder}: holds results of another study (its hash is {other}, that of this one {self.digest}), and the two "
                "are never mixed; name another folder, or remove this one."
            )
        _write(self.folder / _DESCRIPTION, description.encode())

    def _files(self) -> list[Path]:
        return sorted(self._chunks.glob("*.h5"))

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from computing the same study in this folder; the lock ends with the process.

        Raises:
            StorageError: another process holds it.
        """
        with (self.folder / _LOCK).open("w") as file:
            try:
                import fcntl
            except ImportError:  # Windows: nothing is lost without the lock but time, since files appear whole
                yield
                return
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise StorageError(f"{self.folder}: another process is computing this study; wait for it.") from None
            for left in self._chunks.glob(".*.part"):  # of a process that was killed
                left.unlink(missing_ok=True)
            yield

    def done(self) -> list[int]:
        """Numbers of the repetitions that are finished, in ascending order.

        Raises:
            StorageError: a file is damaged, or belongs to another study.
        """
        found: list[int] = []
        for path in self._files():
            with _opened(path) as file:
                self._check(path, file)
                found += [int(n) for n in np.asarray(file["index"])]
        if len(set(found)) < len(found):
            raise StorageError(f"{self.folder}: a repetition is there twice; remove one of the files that hold it.")
        return sorted(found)

    def keep(self, indices: Sequence[int], arrays: Arrays) -> None:
        """Write one chunk.

        Raises:
            OSError: such as a full disk; finished chunks stay as they are.
        """
        _write(self._chunks / f"{indices[0]:08d}.h5", self._packed(indices, arrays))

    def read(self, below: int | None = None) -> tuple[np.ndarray, Arrays]:
        """Numbers of the finished repetitions and all variables, in ascending order.

        Args:
            below: leave out repetitions from this number on.
        """
        indices: list[np.ndarray] = []
        parts: dict[str, list[np.ndarray]] = {name: [] for name in self.layout.variables}
        for path in self._files():
            with _opened(path) as file:
                self._check(path, file)
                indices.append(np.asarray(file["index"], dtype=int))
                for name in parts:
                    dataset = file[name]
                    assert isinstance(dataset, h5py.Dataset)
                    parts[name].append(np.asarray(dataset.asstr()[...] if name in self.layout.texts else dataset[...]))
        if not indices:
            return np.zeros(0, dtype=int), self.layout.empty(0)
        index = np.concatenate(indices)
        order = np.argsort(index, kind="stable")
        order = order if below is None else order[index[order] < below]
        return index[order], {name: np.concatenate(each)[order] for name, each in parts.items()}

    def _packed(self, indices: Sequence[int], arrays: Arrays) -> bytes:
        """Return the chunk as the bytes of an HDF5 file: made in memory, so that a full disk is met by one plain write."""
        made = io.BytesIO()
        with h5py.File(made, "w", track_order=True) as file:
            file.attrs.update({"format": _FORMAT, "version": _VERSION, "digest": self.digest})
            file.attrs["layout"] = json.dumps(self.layout.table())
            file["index"] = np.asarray(indices, dtype=np.int64)
            for name in self.layout.numbers:
                file[name] = np.asarray(arrays[name], dtype=np.float64)
            for name in self.layout.texts:
                file.create_dataset(name, data=arrays[name], dtype=h5py.string_dtype())
        return made.getvalue()

    def _check(self, path: Path, file: h5py.File) -> None:
        if file.attrs.get("digest") != self.digest:
            raise StorageError(f"{path}: holds results of another study; take it out of the folder.")


def description_in(folder: str | os.PathLike[str]) -> str:
    """Return what a folder says that it computes: the TOML text of a study.

    Raises:
        StorageError: the folder holds no study.
    """
    path = Path(folder) / _DESCRIPTION
    if not path.is_file():
        raise StorageError(f"{folder}: holds no study; it has no {_DESCRIPTION}.")
    return path.read_text(encoding="utf-8")


def studies_in(folder: str | os.PathLike[str]) -> list[Path]:
    """Return the folders that hold a study: this one, or those directly in it."""
    top = Path(folder)
    candidates = [top, *sorted(path for path in top.iterdir() if path.is_dir())] if top.is_dir() else []
    return [path for path in candidates if (path / _DESCRIPTION).is_file()]


def _attributes(path: Path) -> dict[str, Any]:
    with _opened(path) as file:
        return dict(file.attrs)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[h5py.File]:
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise StorageError(
            f"{path}: is damaged ({error}); remove it, and its repetitions are computed again."
        ) from None
    with file:
        if file.attrs.get("format") != _FORMAT or file.attrs.get("version") != _VERSION:
            raise StorageError(f"{path}: is no chunk of a study, or one of another version; take it out of the folder.")
        yield file


def _write(path: Path, content: bytes) -> None:
    """Aside, to the disk, then in its place."""
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
