"""MAT files of version 5 that are damaged: refused in a sentence, never the end of the process."""

import re

import numpy as np
import pytest
import scipy.io
from damaged_bytes import flipped

from rtac_jax.measurement import Recording, RecordingError

TIME = 1e-2 * np.arange(40)
WRITTEN = {"i": np.sin(TIME), "x": 1e-3 * np.cos(TIME), "label": "text", "cells": np.array([1, "a"], dtype=object)}
OPTIONS = {"channels": {"current": "i", "cart_position": "x"}, "sample_time": 1e-2, "kind": "forced"}


def read_or_refused(path):
    try:
        return Recording.from_mat(path, **OPTIONS)
    except RecordingError as error:
        said = str(error)
    assert re.match(rf"{re.escape(str(path))}: [^\n]*; [^\n]*\.$", said), said
    return None


@pytest.mark.parametrize("compressed", [False, True])
def test_no_flipped_bit_of_a_header_ends_the_process(tmp_path, compressed):
    """Every bit of the header and of the tags, with SciPy's reader the end of the process in one of forty."""
    path = tmp_path / "run.mat"
    scipy.io.savemat(path, WRITTEN, do_compression=compressed)
    whole = path.read_bytes()
    assert (written := read_or_refused(path)) is not None
    random = np.random.default_rng(0)
    tags = [*range(8 * 124, 8 * 200), *random.integers(8 * 200, 8 * len(whole), 400)]
    refused = 0
    for bit in tags:
        path.write_bytes(flipped(whole, int(bit)))
        found = read_or_refused(path)
        refused += found is None
        if compressed and found is not None:  # the samples have a checksum there
            assert found == written
    assert refused > 200


@pytest.mark.parametrize(
    ("byte", "was", "made"), [(16, 6, 14), (16, 6, 7), (48, 9, 13)], ids=["int64", "single", "uint64"]
)
def test_numbers_of_another_type_than_their_class_has_are_refused(tmp_path, byte, was, made):
    """One bit of a variable's head that turns doubles to whole numbers, to rounded ones, or to what their bytes mean as such."""
    path = tmp_path / "run.mat"
    scipy.io.savemat(path, {key: WRITTEN[key] for key in ("i", "x")})
    content = bytearray(path.read_bytes())
    assert content[128 + byte] == was
    content[128 + byte] = made
    path.write_bytes(content)
    assert read_or_refused(path) is None


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("dtype", ["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"])
def test_every_kind_of_number_is_read_as_scipy_reads_it(tmp_path, compressed, dtype):
    path = tmp_path / "run.mat"
    values = (100 * np.abs(np.sin(TIME))).astype(dtype)
    scipy.io.savemat(path, {"i": values, "x": np.asfortranarray(values[None])}, do_compression=compressed)
    found = Recording.from_mat(path, **OPTIONS)["run"]
    np.testing.assert_array_equal(found.inputs["current"].values, values.astype(float))
    np.testing.assert_array_equal(found.outputs["cart_position"].values, values.astype(float))


def test_what_is_no_vector_of_numbers_is_named(tmp_path):
    path = tmp_path / "run.mat"
    odd = {"i": WRITTEN["i"], "s": {"a": 1.0}, "b": TIME > 1, "z": 1j * TIME, "two": np.ones((2, 20))}
    scipy.io.savemat(path, {**odd, **{key: WRITTEN[key] for key in ("label", "cells")}})
    for name, said in {
        "label": "is a MATLAB char", "cells": "is a MATLAB cell", "s": "is a MATLAB struct", "b": "is a MATLAB logical",
        "z": "the type is complex128", "two": r"the shape is \(2, 20\)", "none": "there is no such variable; the file has i, s",
    }.items():  # fmt: skip
        with pytest.raises(RecordingError, match=f"{name}: {said}"):
            Recording.from_mat(path, **{**OPTIONS, "channels": {"current": "i", "cart_position": name}})


def test_version_4_is_read_too(tmp_path):
    path = tmp_path / "run.mat"
    scipy.io.savemat(path, {key: WRITTEN[key] for key in ("i", "x")}, format="4")
    np.testing.assert_array_equal(Recording.from_mat(path, **OPTIONS)["run"].inputs["current"].values, WRITTEN["i"])
