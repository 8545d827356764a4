"""A file that was damaged after it was written is refused, or says the same as before; never something else."""

import re

import h5py
import numpy as np
import pytest
from command_line import call
from damaged_bytes import flipped, flipped_byte

from rtac_jax.measurement import Experiment, Recording, RecordingError
from rtac_jax.measurement._global_heap import endless

TIME = 1e-2 * np.arange(60)
FLIPS = 400


def recording():
    noise = 1e-5 * np.random.default_rng(0).standard_normal(len(TIME))
    return Recording(
        (
            Experiment.of(
                "forced_1",
                kind="forced",
                sample_time=1e-2,
                current=np.cos(TIME),
                cart_position=np.sin(TIME),
                noise_std={"cart_position": 1e-5},
                initial_arm_angle=1.0,
            ),
            Experiment.of("a_rest", kind="rest", sample_time=1e-2, cart_position=noise),
        ),
        {"total_mass": 1.2, "arm_inertia": 1e-4},
        rig_name="bench",
        comment="größer",
    )


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "rig.h5"
    recording().save(file)
    return file


def read_or_refused(path, expected):
    """Whether the file is refused in one sentence with a mend; where it is not, it must hold what was written."""
    try:
        found = Recording.load(path)
    except RecordingError as error:
        said = str(error)
        assert re.match(rf"{re.escape(str(path))}: /[^:]*: [^\n]*; [^\n]*\.$", said), said
        return True
    assert found == expected
    assert (found.names, found.comment, found.rig_name) == (expected.names, expected.comment, expected.rig_name)
    return False


def test_no_flipped_bit_changes_a_number_unseen(path):
    whole, expected = path.read_bytes(), recording()
    refused = 0
    for bit in np.random.default_rng(1).choice(8 * len(whole), FLIPS, replace=False):
        path.write_bytes(flipped(whole, int(bit)))
        refused += read_or_refused(path, expected)
    assert refused > FLIPS / 5  # the rest is space that nothing uses


def test_no_flipped_byte_changes_a_number_unseen(path):
    whole, expected = path.read_bytes(), recording()
    refused = 0
    for place in np.random.default_rng(0).integers(0, len(whole), 60):
        path.write_bytes(flipped_byte(whole, int(place)))
        refused += read_or_refused(path, expected)
    assert refused > 10


def test_every_flipped_bit_of_a_sample_is_refused_with_its_place(path):
    values = recording()["forced_1"].outputs["cart_position"].values
    whole = path.read_bytes()
    start = whole.find(values.tobytes())
    assert start > 0
    for bit in (0, 51, 64 * 31 + 62, 64 * 59 + 63):
        path.write_bytes(flipped(whole, 8 * start + bit))
        with pytest.raises(
            RecordingError, match=r"/experiments/forced_1/outputs/cart_position: .* copy or write it again"
        ):
            Recording.load(path)


def edited(key, name, value):
    return lambda file: file[key].attrs.__setitem__(name, value)


def shorter(file):
    for name in ("inputs/current", "outputs/cart_position"):
        old = file["experiments/forced_1"][name]
        values, attributes = old[:-1], dict(old.attrs)
        del file["experiments/forced_1"][name]
        file["experiments/forced_1"].create_dataset(name, data=values).attrs.update(attributes)


EDITS = {
    "constant": (edited("rig", "total_mass", 1.3), "/rig"),
    "new constant": (edited("rig", "spring_stiffness", 100.0), "/rig"),
    "angle": (edited("experiments/forced_1", "initial_arm_angle", 2.0), "/experiments/forced_1"),
    "noise": (edited("experiments/forced_1/outputs/cart_position", "noise_std", 1e-4), "outputs/cart_position"),
    "sample": (
        lambda f: f["experiments/forced_1/inputs/current"].__setitem__(3, 0.0),
        "/experiments/forced_1/inputs/current",
    ),
    "length": (shorter, "/experiments/forced_1/inputs/current"),
    "precision": (
        lambda f: f["rig"].attrs.__setitem__("total_mass", np.float32(1.2)),
        "/rig",
    ),
    "gone": (lambda f: f["experiments"].__delitem__("a_rest"), "/experiments/a_rest"),
    "comment": (edited("/", "comment", ""), "/"),
    "digest": (edited("/", "digest", "nonsense"), "/"),
}


@pytest.mark.parametrize(("change", "place"), EDITS.values(), ids=EDITS)
def test_what_is_not_as_it_was_written_is_named_and_can_be_accepted(path, change, place):
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(
        RecordingError, match=rf"{place}: is not what was written there.*delete the attribute digest of /"
    ):
        Recording.load(path)
    with h5py.File(path, "r+") as file:
        del file.attrs["digest"]
    assert len(Recording.load(path)) >= 1


def test_a_note_added_later_is_no_damage(path):
    with h5py.File(path, "r+") as file:
        file["experiments/forced_1"].attrs["operator"] = "somebody"
    assert Recording.load(path) == recording()


def test_many_experiments_are_guarded_too(tmp_path):
    one = recording()["forced_1"]
    many = Recording(tuple(one.cut(0, 60, f"{'long name ' * 20}{n}") for n in range(300)), {"total_mass": 1.0})
    many.save(tmp_path / "many.h5")
    with h5py.File(tmp_path / "many.h5") as file:
        assert len(file.attrs["digest"]) > 1 << 17  # more than an attribute holds in its header
    assert Recording.load(tmp_path / "many.h5") == many


def test_texts_on_which_the_library_would_stand_still_are_refused(path):
    """The first object of the heap of texts becomes free space of no size, at which HDF5 2 loops for ever."""
    whole = bytearray(path.read_bytes())
    heap = whole.find(b"GCOL")
    assert not endless(path)
    whole[heap + 16 : heap + 32] = bytes(16)
    path.write_bytes(bytes(whole))
    assert endless(path)
    with pytest.raises(RecordingError, match="/: the texts in the HDF5 file are damaged; copy or write it again"):
        Recording.load(path)


def test_info_says_whether_anything_guards_the_numbers(path):
    assert "checksums: the file is as it was written." in call("info", path).stdout
    with h5py.File(path, "r+") as file:
        del file.attrs["digest"]
    assert Recording.load(path) == recording()
    assert "nothing guards the numbers" in call("info", path).stdout
