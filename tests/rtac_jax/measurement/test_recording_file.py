"""Recordings in HDF5: nothing is lost, and a file that breaks the layout is refused with the place."""

import h5py
import numpy as np
import pytest

from rtac_jax.measurement import Experiment, Recording, RecordingError

N = 500
T = np.arange(N) * 1e-2
NAMES = ("z last", "a first", "still", "größe")


def recording():
    position = np.sin(T)
    position[[0, 7, N - 1]] = np.nan
    common = {"sample_time": 1 / 3, "current": np.cos(T), "cart_position": position}
    return Recording(
        (
            Experiment.of(
                NAMES[0],
                kind="forced",
                **common,
                disturbance_force=T**2,
                arm_angle=np.nextafter(T, 1),
                intersample={"current": "bl", "disturbance_force": "foh"},
                noise_std={"cart_position": 0.1},
                initial_arm_angle=np.pi,
            ),
            Experiment.of(NAMES[1], kind="forced", **common, cart="clamped"),
            Experiment.of(NAMES[2], kind="rest", sample_time=1e-3, arm_velocity=T[:8] * 5e-324, arm="locked"),
            Experiment.of(NAMES[3], kind="forced", **common, repeat_of=NAMES[1]),
        ),
        {"total_mass": 1.23, "arm_inertia": 9.5e-5, "custom": -1.0},
        rig_name="bench 2",
        comment="two lines\nof text, ünïcode",
    )


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "rig.h5"
    recording().save(file)
    return file


def refuses(path, message):
    with pytest.raises(RecordingError, match=message) as caught:
        Recording.load(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_loses_nothing(path):
    loaded = Recording.load(path)
    assert loaded == recording()
    assert loaded.names == NAMES
    for before, after in zip(recording(), loaded, strict=True):
        assert list(before.outputs) == list(after.outputs)
        for name, signal in before.outputs.items():
            assert signal.values.tobytes() == after.outputs[name].values.tobytes()
            assert not after.outputs[name].values.flags.writeable


def test_a_part_in_which_the_rig_stands_still_is_read_again(tmp_path):
    time = 0.01 * np.arange(400)
    long = Experiment.of("e", kind="free", sample_time=0.01, cart_position=np.where(time < 2, np.cos(time), 0.5))
    Recording((long.cut(200, 400, "still"),)).save(tmp_path / "part.h5")
    (found,) = Recording.load(tmp_path / "part.h5").experiments
    assert found.part
    assert np.ptp(found.outputs["cart_position"].values) == 0
    Recording((long,)).save(tmp_path / "whole.h5")
    assert not Recording.load(tmp_path / "whole.h5")["e"].part


def test_the_file_follows_the_layout(path):
    with h5py.File(path) as file:
        attributes = dict(file.attrs)
        lines = attributes.pop("digest").split("\n")
        assert [line.split(" ", 1)[1] for line in lines][:4] == ["/", "/rig", f"/{X}", f"/{CURRENT}"]
        assert attributes == {
            "format": "rtac-measurement",
            "version": 1,
            "rig": "bench 2",
            "comment": "two lines\nof text, ünïcode",
        }
        group = file["experiments/z last"]
        assert group.attrs["kind"] == "forced"
        assert group["inputs/current"].attrs["unit"] == "A"
        assert group["inputs/current"].attrs["intersample"] == "bl"
        assert group["outputs/cart_position"].attrs["noise_std"] == 0.1
        assert group["outputs/cart_position"].dtype == np.float64
        assert all(signal.fletcher32 for side in group.values() for signal in side.values())
        assert "repeat_of" not in group.attrs


def test_saving_replaces_the_file_whole(path, monkeypatch):
    before = path.read_bytes()
    monkeypatch.setattr("rtac_jax.measurement._hdf5._fill", lambda file, recording: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        recording().save(path)
    assert path.read_bytes() == before
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]


def test_one_experiment_as_text_is_what_was_saved(tmp_path):
    path, first = tmp_path / "rig.csv", recording()[NAMES[0]]
    Recording((first,)).save(path)
    columns = {
        "current": "current [A]", "disturbance_force": "disturbance_force [N]", "cart_position": "cart_position [m]",
        "arm_angle": "arm_angle [rad]",
    }  # fmt: skip
    again = Recording.from_csv(path, channels=columns, kind="forced", time="time [s]")["rig"]
    for channel in columns:
        side = "inputs" if channel in first.inputs else "outputs"
        np.testing.assert_array_equal(getattr(again, side)[channel].values, getattr(first, side)[channel].values)
    assert again.sample_time == pytest.approx(first.sample_time)


def test_what_a_file_cannot_hold_is_refused_before_it_is_written(tmp_path):
    with pytest.raises(RecordingError, match="a CSV file holds one experiment, and this recording has 4"):
        recording().save(tmp_path / "rig.csv")
    with pytest.raises(RecordingError, match=r"rig\.mat: cannot be written; let the name end in \.h5, \.hdf5, \.csv\."):
        recording().save(tmp_path / "rig.mat")
    with pytest.raises(FileNotFoundError, match="there is no such folder"):
        Recording((recording()[NAMES[0]],)).save(tmp_path / "none" / "rig.csv")
    assert not list(tmp_path.iterdir())


def test_a_recording_prints_what_is_in_it_and_no_samples():
    assert "experiments: 4 (3 forced, 1 rest)" in str(recording())
    assert "forced; 500 samples of 0.333333 s" in str(recording())
    assert "cart_position      m     0.7264  3        0.1" in str(recording())
    assert len(str(recording())) < 3000
    assert len(repr(recording())) < 200


def test_a_file_written_by_hand_is_read(tmp_path):
    path = tmp_path / "hand.h5"
    with h5py.File(path, "w") as file:
        file.attrs["format"] = np.bytes_("rtac-measurement")
        file.attrs["version"] = np.array([1.0])
        file.attrs["owner"] = "somebody"
        group = file.create_group("experiments/b")
        group.attrs.update(kind="free", sample_time=np.float32(0.5), operator="somebody")
        for name, dtype in (("cart_position", "<i2"), ("arm_velocity", ">f4"), ("arm_angle", "i8")):
            data = group.create_dataset(f"outputs/{name}", data=np.arange(20).astype(dtype), chunks=(7,), compression=1)
            data.attrs["unit"] = {"cart_position": "m", "arm_velocity": "rad/s", "arm_angle": "rad"}[name]
    loaded = Recording.load(path)
    assert loaded.rig == {}
    assert loaded["b"] == Experiment.of(
        "b",
        kind="free",
        sample_time=0.5,
        cart_position=np.arange(20),
        arm_velocity=np.arange(20),
        arm_angle=np.arange(20),
    )


X = "experiments/z last"


def replaced(name, **options):
    """A change that puts another dataset in place of `name`, with the same attributes."""

    def change(file):
        attributes = dict(file[name].attrs)
        del file[name]
        file.create_dataset(name, **options).attrs.update(attributes)

    return change


def attribute(name, key, value):
    return lambda file: file[name].attrs.__setitem__(key, value)


def linked(name, link):
    def change(file):
        if name in file:
            del file[name]
        file[name] = link

    return change


def virtual(file):
    layout = h5py.VirtualLayout(shape=(N,), dtype="f8")
    layout[:] = h5py.VirtualSource("elsewhere.h5", "data", shape=(N,))
    del file[f"{X}/inputs/current"]
    file.create_virtual_dataset(f"{X}/inputs/current", layout)


CURRENT, POSITION = f"{X}/inputs/current", f"{X}/outputs/cart_position"
HUGE = 10**12
CHANGES = {
    "other format": (attribute("/", "format", "other"), "/: format is 'other', but 'rtac-measurement'"),
    "no format": (lambda f: f.attrs.__delitem__("format"), "/: the attribute format is missing"),
    "numeric format": (attribute("/", "format", 3), "/: the attribute format is 3; store it as a string"),
    "newer version": (attribute("/", "version", 2), "/: version is 2, but 1 was expected"),
    "text version": (attribute("/", "version", "1"), "/: the attribute version is '1'; store it as a number"),
    "no version": (lambda f: f.attrs.__delitem__("version"), "/: the attribute version is missing"),
    "long attribute": (
        attribute("/", "version", np.ones(5)),
        "/: the attribute version is not a single value",
    ),
    "no experiments": (lambda f: f.__delitem__("experiments"), "/experiments: the group is missing"),
    "no experiment": (
        lambda f: [f["experiments"].__delitem__(name) for name in NAMES],
        "/experiments: is empty",
    ),
    "no outputs": (lambda f: f.__delitem__(f"{X}/outputs"), f"/{X}/outputs: the group is missing"),
    "empty outputs": (
        lambda f: [f[f"{X}/outputs"].__delitem__(name) for name in list(f[f"{X}/outputs"])],
        f"/{X}/outputs: is empty",
    ),
    "dataset for group": (linked(X, np.ones(9)), f"/{X}: is not a group"),
    "group for dataset": (lambda f: (f.__delitem__(CURRENT), f.create_group(CURRENT)), "is not a dataset"),
    "stray dataset": (
        linked(f"{X}/inputs/voltage", np.ones(N)),
        f"/{X}/inputs/voltage: is not part of the layout",
    ),
    "stray group": (lambda f: f.create_group(f"{X}/input"), f"/{X}/input: is not part of the layout"),
    "no unit": (
        lambda f: f[POSITION].attrs.__delitem__("unit"),
        f"/{POSITION}: the attribute unit is missing",
    ),
    "wrong unit": (attribute(POSITION, "unit", "mm"), f"/{POSITION}: the unit is 'mm', but 'm' was expected"),
    "wrong kind": (attribute(X, "kind", "odd"), f"/{X}: kind is 'odd'"),
    "no kind": (lambda f: f[X].attrs.__delitem__("kind"), f"/{X}: the attribute kind is missing"),
    "no sample time": (
        lambda f: f[X].attrs.__delitem__("sample_time"),
        f"/{X}: the attribute sample_time is missing",
    ),
    "text sample time": (attribute(X, "sample_time", "1 ms"), f"/{X}: the attribute sample_time is '1 ms'"),
    "true sample time": (
        attribute(X, "sample_time", True),
        f"/{X}: the attribute sample_time is not a single",
    ),
    "not UTF-8": (attribute(X, "kind", np.bytes_(b"\xff\xfe")), f"/{X}: attribute kind: could not be read"),
    "bad repeat": (
        attribute(X, "repeat_of", "gone"),
        f"/{X}: repeat_of is 'gone', which is not in the recording",
    ),
    "rig in words": (attribute("rig", "total_mass", "1.2 kg"), "/rig: the attribute total_mass is '1.2 kg'"),
    "negative mass": (attribute("rig", "total_mass", -1.0), "/rig/total_mass: the constant is -1"),
    "noise": (attribute(POSITION, "noise_std", -1.0), f"/{POSITION}: noise_std is -1"),
    "intersample": (attribute(CURRENT, "intersample", "linear"), f"/{CURRENT}: intersample is 'linear'"),
    "length": (replaced(CURRENT, data=np.ones(N - 1)), f"/{CURRENT}: has 499 samples, but .* has 500"),
    "three samples": (
        replaced("experiments/still/outputs/arm_velocity", data=np.ones(3)),
        "/experiments/still/outputs/arm_velocity: has 3 samples",
    ),
    "row": (replaced(CURRENT, data=np.ones((1, N))), rf"/{CURRENT}: the shape is \(1, 500\), but one axis"),
    "scalar": (replaced(CURRENT, data=1.0), rf"/{CURRENT}: the shape is \(\), but one axis"),
    "null": (replaced(CURRENT, data=h5py.Empty("f8")), f"/{CURRENT}: holds no samples"),
    "all NaN": (replaced(POSITION, data=np.full(N, np.nan)), f"/{POSITION}: all 500 samples are missing"),
    "constant": (replaced(POSITION, data=np.ones(N)), f"/{POSITION}: all samples are 1"),
    "infinite": (replaced(CURRENT, data=np.full(N, np.inf)), f"/{CURRENT}, sample 0: the value is inf"),
    "strings": (replaced(CURRENT, data=["a"] * N), f"/{CURRENT}: the type is object, but float64"),
    "vlen": (replaced(CURRENT, shape=(N,), dtype=h5py.vlen_dtype(float)), f"/{CURRENT}: the type is object"),
    "references": (replaced(CURRENT, shape=(N,), dtype=h5py.ref_dtype), f"/{CURRENT}: the type is object"),
    "bytes": (replaced(CURRENT, data=np.array([b"a"] * N)), f"/{CURRENT}: the type is .*S1"),
    "complex": (replaced(CURRENT, data=np.ones(N) * 1j), f"/{CURRENT}: the type is complex128"),
    "records": (replaced(CURRENT, shape=(N,), dtype=[("a", "f8")]), f"/{CURRENT}: the type is "),
    "long integers": (
        replaced(CURRENT, data=np.full(N, 2**60)),
        rf"/{CURRENT}: holds integers beyond 2\*\*53",
    ),
    "too long": (
        replaced(CURRENT, shape=(HUGE,), dtype="f8", chunks=(1000,)),
        f"/{CURRENT}: declares the shape",
    ),
    "too large for the file": (
        replaced(CURRENT, shape=(10**8,), dtype="f8", chunks=(1000,)),
        rf"/{CURRENT}: declares the shape \(100000000,\), far more than the file can hold",
    ),
    "large chunk": (
        replaced(CURRENT, shape=(N,), maxshape=(None,), dtype="f8", chunks=(10**8,)),
        f"/{CURRENT}: declares the shape",
    ),
    "external link": (linked(CURRENT, h5py.ExternalLink("/etc/passwd", "/")), f"/{CURRENT}: is a link"),
    "external group": (linked(X, h5py.ExternalLink("other.h5", "/x")), f"/{X}: is a link"),
    "soft link": (linked(CURRENT, h5py.SoftLink(f"/{POSITION}")), f"/{CURRENT}: is a link"),
    "dangling link": (linked("rig", h5py.SoftLink("/nowhere")), "/rig: is a link"),
    "external storage": (
        replaced(CURRENT, shape=(N,), dtype="f8", external=[("elsewhere.bin", 0, N * 8)]),
        f"/{CURRENT}: keeps its samples in another file",
    ),
    "virtual": (virtual, f"/{CURRENT}: keeps its samples in another file"),
}


@pytest.mark.parametrize(("change", "message"), CHANGES.values(), ids=CHANGES)
def test_a_file_that_breaks_the_layout_is_refused(path, change, message):
    with h5py.File(path, "r+") as file:
        change(file)
    refuses(path, message)


def test_an_experiment_linked_many_times_does_not_fill_the_memory(path, monkeypatch):
    monkeypatch.setattr("rtac_jax.measurement._hdf5.MOST_ELEMENTS", 20 * N)
    with h5py.File(path, "r+") as file:
        for copy in range(20):
            file[f"experiments/copy {copy}"] = file[X]
    refuses(path, "declares the shape")


def test_what_is_no_recording_is_refused(tmp_path, path):
    with pytest.raises(FileNotFoundError, match=r"none.h5: there is no such file"):
        Recording.load(tmp_path / "none.h5")
    with pytest.raises(FileNotFoundError, match="none: there is no such folder"):
        recording().save(tmp_path / "none" / "rig.h5")
    refuses(tmp_path, "/: this is not a file")
    text = tmp_path / "text.h5"
    text.write_text("t,x\n1,2\n")
    refuses(text, "/: this is not an HDF5 file; import MAT and CSV files with rtac import, or with from_mat")
    text.write_bytes(b"")
    refuses(text, "/: this is not an HDF5 file")


def test_a_file_that_is_cut_off_is_refused(path):
    whole = path.read_bytes()
    for length in (100, len(whole) // 3, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        refuses(path, "damaged, truncated or not readable")
