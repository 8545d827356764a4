"""A digest of what a file means, so that a damaged one is never read as other numbers."""

import hashlib
from collections.abc import Iterator, Mapping

import numpy as np

from ._contents import Contents
from ._errors import RecordingError

ATTRIBUTE = "digest"
# 64 bits: damage that nobody intends goes unseen once in 10**19 times.
DIGITS = 16


def digest(recording: Contents) -> str:
    """Return one line for each group and data set of a recording's file: its SHA-256 and its path, in the file's order.

    What is hashed is what a reader makes of the file: every attribute with its name and type, and every sample. Whatever
    part of the file is damaged (a sample, a shape, a type, an order, a pointer inside HDF5), the recording that comes
    out of it either is the one that was written or has another digest. Attributes that the layout does not know may be
    added later.
    """
    return "\n".join(f"{value} {path}" for path, value in _parts(recording))


def verify(recording: Contents, written: str) -> None:
    """Compare a recording that was read with the digest that its file carries.

    Raises:
        RecordingError: they differ; it names the first path that is not what was written.
    """
    stored = dict(_split(line) for line in written.split("\n"))
    read = dict(_parts(recording))
    if list(stored.items()) == list(read.items()):
        return
    place = next((path for path in read if stored.get(path) != read[path]), None)
    place = place or next((path for path in stored if path not in read), "/")
    raise RecordingError(
        f"{place}: is not what was written there, as its digest says; the file is damaged, so copy or write it again, or, "
        f"if it was changed on purpose, delete the attribute {ATTRIBUTE} of /."
    )


def _split(line: str) -> tuple[str, str]:
    value, _, path = line.partition(" ")
    return path, value


def _parts(recording: Contents) -> Iterator[tuple[str, str]]:
    yield "/", _hash({"rig": recording.rig_name, "comment": recording.comment})
    # In order of name: HDF5 keeps no order of attributes unless it is asked to.
    yield "/rig", _hash(dict(sorted(recording.rig_attributes.items())))
    for experiment in recording.experiments:
        place = f"/experiments/{experiment.name}"
        names = ("kind", "sample_time", "initial_arm_angle", "arm", "cart", "repeat_of")
        kept = {name: getattr(experiment, name) for name in names}
        if experiment.initial_arm_angle_std is not None:  # files from before there was one keep their digest
            kept["initial_arm_angle_std"] = experiment.initial_arm_angle_std
        yield place, _hash(kept)
        for side, signals in (("inputs", experiment.inputs), ("outputs", experiment.outputs)):
            for name, signal in signals.items():
                kept = {key: getattr(signal, key) for key in ("unit", "intersample", "noise_std")}
                yield f"{place}/{side}/{name}", _hash(kept, signal.values)


def _hash(attributes: Mapping[str, object], values: np.ndarray | None = None) -> str:
    made = hashlib.sha256()
    for name, value in attributes.items():
        # repr tells 1 from 1.0 and from "1", and gives every bit of a float.
        made.update(f"{name}={value!r}\n".encode())
    if values is not None:
        made.update(f"{len(values)} samples\n".encode())
        made.update(values.astype("<f8", copy=False).data)
    return made.hexdigest()[:DIGITS]
