"""Structures and matrices in MAT files, as Simulink and loggers write them: named as in MATLAB, or refused in a sentence."""

import re
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
from damaged_bytes import flipped

from rtac_jax.measurement import Recording, RecordingError

TIME = 1e-2 * np.arange(40)
CURRENT, POSITION = np.sin(TIME), 1e-3 * np.cos(TIME)
SIGNALS = np.array(
    [[(CURRENT[:, None], "motor"), (POSITION[:, None], "cart")]], dtype=[("values", object), ("label", object)]
)
HELD = {
    "out": {
        "time": TIME[:, None],
        "current": CURRENT,
        "note": "first",
        "cart": {"q": POSITION, "empty": np.zeros((0, 0))},
    },
    "scope": {"time": TIME[:, None], "signals": SIGNALS},  # "Structure with time"
    "log": np.column_stack([TIME, CURRENT, POSITION]),  # "Array"
    "ans": np.vstack([TIME, CURRENT, POSITION]),  # "To File"
}
ADDRESSES = {
    "fields": ("out.time", "out.current", "out.cart.q"),
    "structure array": ("scope.time", "scope.signals(1).values", "scope.signals(2).values"),
    "columns": ("log(:,1)", "log(:, 2)", "log(:,3)"),
    "rows": ("ans(1,:)", "ans(2,:)", "ans( 3 , : )"),
}


def version_7_3(path: Path) -> None:
    """Write the same as MATLAB does: its columns as rows, and the fields of a structure array as references."""
    with h5py.File(path, "w", userblock_size=512) as file:

        def write(group: h5py.Group, name: str, values: np.ndarray) -> h5py.Dataset:
            stored = group.create_dataset(name, data=np.atleast_2d(values).T)
            stored.attrs["MATLAB_class"] = np.bytes_("double")
            return stored

        def structure(name: str) -> h5py.Group:
            group = file.create_group(name)
            group.attrs["MATLAB_class"] = np.bytes_("struct")
            return group

        out, cart, scope, signals = (structure(n) for n in ("out", "out/cart", "scope", "scope/signals"))
        write(out, "time", TIME[:, None])
        write(out, "current", CURRENT)
        write(cart, "q", POSITION)
        write(scope, "time", TIME[:, None])
        targets = [write(file, f"#refs#/{name}", values) for name, values in (("a", CURRENT), ("b", POSITION))]
        references = np.array([[target.ref] for target in targets], dtype=h5py.ref_dtype)
        signals.create_dataset("values", data=references, dtype=h5py.ref_dtype)
        cells = out.create_dataset("cells", data=references, dtype=h5py.ref_dtype)
        cells.attrs["MATLAB_class"] = np.bytes_("cell")
        write(file, "log", HELD["log"])
        write(file, "ans", HELD["ans"])
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + path.read_bytes()[128:])


def written(path: Path, version: str) -> Path:
    if version == "7.3":
        version_7_3(path)
    else:
        scipy.io.savemat(path, HELD, do_compression=version == "7")
    return path


def read(path: Path, time: str, current: str, position: str) -> Recording:
    return Recording.from_mat(path, channels={"current": current, "cart_position": position}, time=time, kind="forced")


@pytest.mark.parametrize("version", ["6", "7", "7.3"])
@pytest.mark.parametrize("names", ADDRESSES.values(), ids=ADDRESSES)
def test_fields_columns_and_rows_are_read_as_matlab_names_them(
    tmp_path: Path, version: str, names: tuple[str, ...]
) -> None:
    experiment = read(written(tmp_path / "run.mat", version), *names).experiments[0]
    assert experiment.sample_time == pytest.approx(1e-2)
    np.testing.assert_array_equal(experiment.inputs["current"].values, CURRENT)
    np.testing.assert_array_equal(experiment.outputs["cart_position"].values, POSITION)


@pytest.mark.parametrize("version", ["6", "7", "7.3"])
@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("out", r"out: is a MATLAB struct, .*name one of its fields, out\.time, out\.current"),
        ("out.cart", r"name one of its fields, out\.cart\.q"),
        ("out.speed", r"out\.speed: there is no field speed; there are time, current"),
        ("out.current.rms", r"rms is no field"),
        ("scope.signals(3).values", r"signals has 2 elements; name one of them, as signals\(1\)"),
        ("log", r"the shape is \(40, 3\), but a vector was expected; name a column as log\(:,1\)"),
        ("log(:,4)", r"the shape is \(40, 3\); name one of its columns"),
        ("ans(4,:)", r"the shape is \(3, 40\); name one of its rows"),
        ("nothing(:,1)", r"there is no such variable; the file has out, scope, log, ans"),
    ],
)
def test_an_address_of_nothing_is_told_what_there_is(tmp_path: Path, version: str, name: str, said: str) -> None:
    path = written(tmp_path / "run.mat", version)
    if version == "7.3":
        said = re.sub("out, scope, log, ans", "ans, log, out, scope", said).replace(
            r"out\.time, out\.current", r"out\.cart, out\.cells, out\.current, out\.time"
        )
        said = said.replace("time, current", "cart, cells, current, time")
    with pytest.raises(RecordingError, match=said):
        read(path, "log(:,1)", name, "log(:,3)")


@pytest.mark.parametrize("version", ["6", "7", "7.3"])
@pytest.mark.parametrize("name", ["out.current(2)", "log(5)"])
def test_an_element_of_a_vector_is_no_channel(tmp_path: Path, version: str, name: str) -> None:
    with pytest.raises(RecordingError, match="there is no such variable"):
        read(written(tmp_path / "run.mat", version), "log(:,1)", name, "log(:,3)")


def test_a_cell_array_of_version_7_3_is_no_structure_array(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"out\.cells: is a MATLAB cell"):
        read(written(tmp_path / "run.mat", "7.3"), "log(:,1)", "out.cells", "log(:,3)")


def test_a_field_without_samples_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"the lengths differ \(.*'out\.cart\.empty': 0"):
        read(written(tmp_path / "run.mat", "7"), "out.time", "out.cart.empty", "out.cart.q")
    with pytest.raises(RecordingError, match=r"out\.note: is a MATLAB char"):
        read(tmp_path / "run.mat", "out.time", "out.note", "out.cart.q")


@pytest.mark.parametrize("compressed", [False, True])
def test_no_flipped_bit_of_a_structure_ends_the_process(tmp_path: Path, compressed: bool) -> None:
    path = tmp_path / "run.mat"
    scipy.io.savemat(path, {"scope": HELD["scope"]}, do_compression=compressed)
    whole, said = path.read_bytes(), []
    for bit in np.random.default_rng(0).integers(8 * 128, 8 * len(whole), 600):
        path.write_bytes(flipped(whole, int(bit)))
        try:
            read(path, *ADDRESSES["structure array"])
        except RecordingError as error:
            said.append(str(error))
    assert len(said) > 10
    assert not [one for one in said if not re.match(rf"{re.escape(str(path))}: [^\n]*; [^\n]*\.$", one)]
