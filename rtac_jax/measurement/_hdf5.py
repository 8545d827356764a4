"""Recordings in HDF5, layout "rtac-measurement", version 1. Nothing is guessed, and no file is trusted."""

import io
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import h5py
import numpy as np
from jaxtyping import Float64

from ._contents import Contents
from ._digest import ATTRIBUTE, digest, verify
from ._errors import RecordingError
from ._experiment import Experiment, check_name
from ._global_heap import endless
from ._signal import INPUTS, OUTPUTS, Signal
from .atomic_write import replacing

Made = TypeVar("Made", bound=Contents)

FORMAT = "rtac-measurement"
VERSION = 1
DESIGNED = "not measurements"
"""What the comment of a recording says that was designed to be played."""
MOST_ELEMENTS = 200_000_000
# Deflate never exceeds about 1000:1, and only on constants; a real recording compresses far less than this.
MOST_EXPANSION = 64
SLACK_BYTES = 1 << 20
# HDF5's own checksum is kept for each chunk: 512 kB, which its cache of 1 MB holds.
CHUNK_SAMPLES = 1 << 16
# With this version HDF5 keeps checksums of what describes a group or a data set, too; every reader since 2008 knows it.
LIBRARY_VERSION = "v108"


def write(path: str | os.PathLike[str], recording: Contents) -> None:
    """Write `recording` to `path`; an interrupted write leaves an earlier file as it was.

    Every data set carries HDF5's checksum, and the root a digest of everything, which `read` verifies.
    """
    options: dict[str, Any] = {"track_order": True, "libver": (LIBRARY_VERSION, LIBRARY_VERSION)}
    # In memory first: when the disk is full, HDF5 fails again on every attempt to close, and can end the process.
    content = io.BytesIO()
    with replacing(path) as temporary:
        with h5py.File(content, "w", **options) as file:
            _fill(file, recording)
        temporary.write_bytes(content.getbuffer())


def holds_measurements(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is there that is a recording, and not one that was designed to be played."""
    try:
        with h5py.File(path, "r") as file:
            return file.attrs.get("format") == FORMAT and DESIGNED not in str(file.attrs.get("comment", ""))
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, UnicodeError):
        return False  # no such file, or none that anybody could read


def _fill(file: h5py.File, recording: Contents) -> None:
    file.attrs.update(format=FORMAT, version=VERSION, rig=recording.rig_name, comment=recording.comment)
    file.attrs[ATTRIBUTE] = digest(recording)
    file.create_group("rig").attrs.update(recording.rig_attributes)
    experiments = file.create_group("experiments", track_order=True)
    for experiment in recording.experiments:
        group = experiments.create_group(experiment.name)
        for name in ("kind", "sample_time", "arm", "cart", "initial_arm_angle", "initial_arm_angle_std", "repeat_of"):
            value = getattr(experiment, name)
            if value is not None:
                group.attrs[name] = value
        if experiment.part:
            group.attrs["part"] = 1
        for side, signals in (("inputs", experiment.inputs), ("outputs", experiment.outputs)):
            folder = group.create_group(side)
            for name, signal in signals.items():
                chunks = (min(len(signal.values), CHUNK_SAMPLES),)
                dataset = folder.create_dataset(name, data=signal.values, chunks=chunks, fletcher32=True)
                for key in ("unit", "intersample", "noise_std"):
                    value = getattr(signal, key)
                    if value is not None:
                        dataset.attrs[key] = value


def read(
    path: str | os.PathLike[str], make: Callable[[tuple[Experiment, ...], dict[str, float], str, str], Made]
) -> Made:
    """Return what `make` makes of the experiments in the file, the constants of its rig, the rig's name and the comment.

    Raises `FileNotFoundError`, or `RecordingError` saying where and how the file departs from the layout.
    """
    try:
        with open_hdf5(path) as file:
            return _read_file(file, Budget(os.path.getsize(path)), make)
    except RecordingError as error:
        # Said once, here, so that no reader below needs to know the name of the file.
        raise RecordingError(f"{os.fspath(path)}: {error}") from error.__cause__


def guarded_by_digest(path: str | os.PathLike[str]) -> bool:
    """Return whether a file carries the digest that `read` verifies."""
    with open_hdf5(path) as file:
        return ATTRIBUTE in file.attrs


def _read_file(
    file: h5py.File, budget: "Budget", make: Callable[[tuple[Experiment, ...], dict[str, float], str, str], Made]
) -> Made:
    found = text(file, "format", required=True)
    if found != FORMAT:
        raise RecordingError(
            f"/: format is {found!r}, but {FORMAT!r} was expected; import other files from MAT or CSV."
        )
    version = number(file, "version", required=True)
    if version != VERSION:
        raise RecordingError(
            f"/: version is {version:g}, but {VERSION} was expected; update rtac-jax or convert the file."
        )
    members = children(file, ("rig", "experiments"))
    rig = {}
    if "rig" in members:
        group = _group(members["rig"], children_allowed=())
        rig = {str(name): number(group, name, required=True) for name in group.attrs}
    if "experiments" not in members:
        raise RecordingError("/experiments: the group is missing; add it with one group for each experiment.")
    folders = children(_group(members["experiments"]), None)
    recording = make(
        tuple(_read_experiment(name, folder, budget) for name, folder in folders.items()),
        rig,
        text(file, "rig") or "",
        text(file, "comment") or "",
    )
    written = text(file, ATTRIBUTE)
    if written is not None:
        verify(recording, written)
    return recording


def _read_experiment(name: str, folder: Any, budget: "Budget") -> Experiment:
    check_name(name)
    members = children(_group(folder), ("inputs", "outputs"))
    if "outputs" not in members:
        raise RecordingError(
            f"{folder.name}/outputs: the group is missing; add it with at least one of {', '.join(OUTPUTS)}."
        )
    inputs, outputs = {}, {}
    if "inputs" in members:
        for key, dataset in children(_group(members["inputs"]), tuple(INPUTS)).items():
            values, unit = _channel(dataset, INPUTS[key], budget)
            inputs[key] = Signal(values, unit, intersample=text(dataset, "intersample") or "zoh")
    for key, dataset in children(_group(members["outputs"]), tuple(OUTPUTS)).items():
        values, unit = _channel(dataset, OUTPUTS[key], budget)
        outputs[key] = Signal(values, unit, noise_std=number(dataset, "noise_std"))
    return Experiment(
        name=name,
        kind=text(folder, "kind", required=True),
        sample_time=number(folder, "sample_time", required=True),
        inputs=inputs,
        outputs=outputs,
        initial_arm_angle=number(folder, "initial_arm_angle"),
        arm=text(folder, "arm") or "free",
        cart=text(folder, "cart") or "free",
        repeat_of=text(folder, "repeat_of"),
        initial_arm_angle_std=number(folder, "initial_arm_angle_std"),
        part=bool(number(folder, "part")),
    )


def _channel(dataset: Any, unit: str, budget: "Budget") -> tuple[Float64[np.ndarray, " sample"], str]:
    values = budget.values(dataset)
    if values.ndim != 1:
        raise RecordingError(
            f"{dataset.name}: the shape is {values.shape}, but one axis, [N], was expected; store one "
            "channel as a vector."
        )
    found = text(dataset, "unit")
    if found is None:
        raise RecordingError(
            f"{dataset.name}: the attribute unit is missing; add unit={unit!r} if the values are in it."
        )
    return values, found


@contextmanager
def guarded(place: str) -> Iterator[None]:
    """Turn whatever h5py raises inside into a `RecordingError` at `place`."""
    try:
        yield
    except RecordingError:
        raise
    except Exception as error:
        # h5py has no error of its own: a damaged file can raise OSError, KeyError, RuntimeError, TypeError
        # and others.
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise RecordingError(
            f"{place}: could not be read ({reason}); the file is damaged or not complete, so copy or write it again."
        ) from error


@contextmanager
def open_hdf5(path: str | os.PathLike[str]) -> Iterator[h5py.File]:
    """Yield the file, open for reading.

    Raises:
        FileNotFoundError: there is no such file.
        RecordingError: it cannot be opened as HDF5.
    """
    if not os.path.exists(path):
        raise FileNotFoundError(f"{os.fspath(path)}: there is no such file; check the path.")
    if not (os.path.isfile(path) and os.access(path, os.R_OK)):
        raise RecordingError("/: this is not a file that can be read; give the path of an HDF5 file.")
    if endless(path):
        raise RecordingError("/: the texts in the HDF5 file are damaged; copy or write it again.")
    try:
        known = h5py.is_hdf5(path)
        file = h5py.File(path, "r") if known else None
    except Exception as error:
        raise RecordingError(
            "/: the HDF5 file cannot be opened; it is damaged, truncated or not readable, so copy or write it again."
        ) from error
    if file is None:
        raise RecordingError(
            "/: this is not an HDF5 file; import MAT and CSV files with rtac import, or with from_mat and from_csv."
        )
    with file, guarded("/"):
        yield file


def children(group: h5py.Group, known: tuple[str, ...] | None) -> dict[str, Any]:
    """Return the members of `group` by name, in order of creation where the file keeps it.

    Raises `RecordingError` for a link to elsewhere and for a name that is not `known`.
    """
    members = {}
    with guarded(str(group.name)):
        for name in group:
            place = f"{str(group.name).rstrip('/')}/{name}"
            if known is not None and name not in known:
                raise RecordingError(f"{place}: is not part of the layout; only {' and '.join(known)} may be here.")
            # A soft or external link can lead to another file, or nowhere.
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                raise RecordingError(f"{place}: is a link, which is not followed; store the data itself there.")
            with guarded(place):
                members[name] = group[name]
    return members


def _group(
    member: h5py.Group | h5py.Dataset | h5py.Datatype, children_allowed: tuple[str, ...] | None = None
) -> h5py.Group:
    if not isinstance(member, h5py.Group):
        raise RecordingError(f"{member.name}: is not a group; store a group there.")
    if children_allowed is not None:
        children(member, children_allowed)
    return member


class Budget:
    """The memory that a file may make us allocate: bounded by its size, and over all datasets together."""

    def __init__(self, file_bytes: int) -> None:
        self.largest = MOST_EXPANSION * file_bytes + SLACK_BYTES
        self.elements = MOST_ELEMENTS

    def values(self, dataset: Any) -> Float64[np.ndarray, "..."]:
        """Return the dataset as float64, read-only, exactly.

        Raises `RecordingError` for anything but plain real numbers inside the file.
        """
        place = str(dataset.name)
        if not isinstance(dataset, h5py.Dataset):
            raise RecordingError(f"{place}: is not a dataset; store the samples there.")
        with guarded(place):
            if dataset.dtype.kind not in "fiu" or dataset.dtype.itemsize > 8:
                raise RecordingError(
                    f"{place}: the type is {dataset.dtype}, but float64 was expected; store the samples as numbers."
                )
            if dataset.shape is None:
                raise RecordingError(f"{place}: holds no samples; store a vector there.")
            if dataset.external or dataset.is_virtual:
                raise RecordingError(f"{place}: keeps its samples in another file; store them in this one.")
            # A chunk is read whole, so it counts even when the dataset is shorter.
            extent = max(_product(dataset.shape), _product(dataset.chunks or ()))
            if extent > self.elements or extent * dataset.dtype.itemsize > self.largest:
                raise RecordingError(
                    f"{place}: declares the shape {dataset.shape}, far more than the file can hold or than "
                    f"the {MOST_ELEMENTS} values that are read at most; write the file again, or in parts."
                )
            self.elements -= extent
            raw = dataset[()]
        values = np.asarray(raw, dtype=np.float64)
        if raw.dtype.kind in "iu" and raw.dtype.itemsize == 8 and np.any(np.abs(values) > 2.0**53):
            raise RecordingError(f"{place}: holds integers beyond 2**53, which float64 cannot; store them as float64.")
        values.flags.writeable = False
        return values


def _product(shape: tuple[int, ...]) -> int:
    # Python integers do not overflow, as a hostile shape would make those of NumPy do.
    result = 1
    for length in shape:
        result *= int(length)
    return result


def _attribute(item: Any, name: str, expected: str, required: bool) -> Any:
    place = str(item.name)
    with guarded(f"{place}: attribute {name}"):
        if name not in item.attrs:
            if required:
                raise RecordingError(f"{place}: the attribute {name} is missing; add it as {expected}.")
            return None
        handle = item.attrs.get_id(name)
        # Looked at before reading: an attribute can declare any shape and type.
        plain = h5py.check_string_dtype(handle.dtype) is not None or handle.dtype.kind in "fiu"
        if not plain or handle.get_space().get_simple_extent_npoints() != 1:
            raise RecordingError(f"{place}: the attribute {name} is not a single value; store it as {expected}.")
        value = item.attrs[name]
        return value if isinstance(value, str) else np.asarray(value).item()


def text(item: Any, name: str, *, required: bool = False) -> Any:
    """Return a string attribute; None where it is absent and not required."""
    value = _attribute(item, name, "a string", required)
    if isinstance(value, bytes):
        with guarded(f"{item.name}: attribute {name}"):
            value = value.decode()
    if not (value is None or isinstance(value, str)):
        raise RecordingError(f"{item.name}: the attribute {name} is {value!r}; store it as a string.")
    return value


def number(item: Any, name: str, *, required: bool = False) -> Any:
    """Return a numeric attribute as float; None where it is absent and not required."""
    value = _attribute(item, name, "a number", required)
    if isinstance(value, (str, bytes)):
        raise RecordingError(f"{item.name}: the attribute {name} is {value!r}; store it as a number.")
    return None if value is None else float(value)
