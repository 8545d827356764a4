"""Files that anything may have happened to: read as they were written, or refused in a sentence; never a crash."""

import io

import h5py
import numpy as np
import pytest
import scipy.io
from damaged_bytes import flipped
from fuzz import NAMES, ODD, fuzz, outcome, printable, sizes
from hypothesis import assume
from hypothesis import strategies as st

from rtac_jax.measurement import INPUTS, OUTPUTS, Experiment, Recording, concerns, describe

TIME = 1e-2 * np.arange(40)


def recording():
    shared = {"sample_time": 1e-2, "current": np.cos(TIME), "cart_position": np.sin(TIME), "initial_arm_angle": 0.5}
    noise = 1e-5 * np.random.default_rng(0).standard_normal(len(TIME))
    return Recording(
        (
            Experiment.of("forced_1", kind="forced", **shared, noise_std={"cart_position": 1e-5}),
            Experiment.of("forced_2", kind="forced", **shared, repeat_of="forced_1"),
            Experiment.of("rest", kind="rest", sample_time=1e-3, arm_velocity=noise),
        ),
        {"total_mass": 1.2, "arm_inertia": 1e-4},
        rig_name="bench",
        comment="größer",
    )


@pytest.fixture
def path(tmp_path):
    recording().save(tmp_path / "rig.h5")
    return tmp_path / "rig.h5"


def same(found, expected):
    assert found == expected
    assert (found.names, found.comment, found.rig_name) == (expected.names, expected.comment, expected.rig_name)


def usable(found, folder):
    """What was accepted can be described and is kept whole by a file."""
    assert describe(found)
    assert all(sentence.endswith(".") for sentence in concerns(found))
    found.save(folder / "again.h5")
    same(Recording.load(folder / "again.h5"), found)


DAMAGE = st.one_of(
    st.tuples(st.just("bits"), st.lists(st.floats(0, 1, exclude_max=True), min_size=1, max_size=3)),
    st.tuples(st.just("cut"), st.floats(0, 1)),
    st.tuples(st.just("zeros"), st.tuples(st.floats(0, 1), st.integers(1, 200))),
    st.tuples(st.just("twice"), st.tuples(st.floats(0, 1), st.integers(1, 200))),
    st.tuples(st.just("after"), st.binary(min_size=1, max_size=40)),
)


def damaged(whole, damage):
    kind, how = damage
    if kind == "bits":
        return flipped(whole, *(int(share * 8 * len(whole)) for share in how))
    if kind == "cut":
        return whole[: int(how * len(whole))]
    if kind == "after":
        return whole + how
    first, length = int(how[0] * len(whole)), how[1]
    block = bytes(length) if kind == "zeros" else whole[first : first + length]
    return whole[:first] + block + whole[first + (length if kind == "zeros" else 0) :]


@sizes(120, 900)
def test_damaged_bytes_of_a_file_with_checksums(trials, path):
    whole, expected = path.read_bytes(), recording()
    refused = []

    @fuzz(trials, damage=DAMAGE)
    def trial(damage):
        path.write_bytes(damaged(whole, damage))
        found = outcome(Recording.load, path)
        refused.append(found is None)
        if found is not None:
            same(found, expected)

    trial()
    assert 0.3 < np.mean(refused) < 1  # both happen


@sizes(60, 400)
def test_damaged_bytes_of_a_file_without_checksums(trials, path, tmp_path):
    content = io.BytesIO(path.read_bytes())
    with h5py.File(content, "r+") as file:
        del file.attrs["digest"]
    whole = content.getvalue()

    @fuzz(trials, damage=DAMAGE)
    def trial(damage):
        path.write_bytes(damaged(whole, damage))
        found = outcome(Recording.load, path)
        if found is not None:
            usable(found, tmp_path)

    trial()


X = "experiments/forced_1"
PLACES = [
    "/",
    "rig",
    "experiments",
    X,
    f"{X}/inputs",
    f"{X}/outputs",
    f"{X}/inputs/current",
    f"{X}/outputs/cart_position",
]
ATTRIBUTES = ["format", "version", "rig", "comment", "kind", "sample_time", "unit", "noise_std", "intersample", "arm",
              "cart", "repeat_of", "initial_arm_angle", "total_mass", "odd"]  # fmt: skip
ARRAYS = st.sampled_from(
    [np.ones(3), np.ones((2, 2)), np.zeros(0), np.float32(0.1), np.bytes_(b"\xff\xfe"), h5py.Empty("f8")]
)
SAMPLES = st.sampled_from(
    [np.ones(40), np.full(40, np.nan), np.full(40, np.inf), np.arange(40), np.arange(40) * 1e300, np.arange(7.0), np.zeros(0),
     np.sin(TIME)[:, None], np.sin(TIME) * 1j, np.sin(TIME) > 0, np.arange(40) + 2**60, np.float16(np.sin(TIME)), ["a"] * 40,
     5.0, np.sin(TIME) * 5e-324]
)  # fmt: skip
EDIT = st.one_of(
    st.tuples(st.just("delete"), st.sampled_from(PLACES[1:])),
    st.tuples(st.just("rename"), st.sampled_from(PLACES[1:]), NAMES),
    st.tuples(st.just("copy"), st.sampled_from(PLACES[1:]), NAMES),
    st.tuples(st.just("attribute"), st.sampled_from(PLACES), st.sampled_from(ATTRIBUTES), st.one_of(ODD, ARRAYS)),
    st.tuples(st.just("no attribute"), st.sampled_from(PLACES), st.sampled_from(ATTRIBUTES)),
    st.tuples(st.just("samples"), st.sampled_from(PLACES[-2:]), SAMPLES),
    st.tuples(st.just("group"), st.sampled_from(PLACES[:-2]), NAMES),
)


def edit(file, kind, place, *more):
    if kind == "delete":
        del file[place]
    elif kind in ("rename", "copy"):
        (file.move if kind == "rename" else file.copy)(place, f"{file[place].parent.name}/{more[0]}")
    elif kind == "attribute":
        file[place].attrs[more[0]] = more[1]
    elif kind == "no attribute":
        del file[place].attrs[more[0]]
    elif kind == "samples":
        attributes = dict(file[place].attrs)
        del file[place]
        file.create_dataset(place, data=more[0]).attrs.update(attributes)
    else:
        file[place].create_group(more[0])


@sizes(60, 500)
@pytest.mark.parametrize("guarded", [True, False], ids=["with checksums", "without"])
def test_files_that_somebody_edited(trials, guarded, path, tmp_path):
    whole, expected = path.read_bytes(), recording()

    @fuzz(trials, edits=st.lists(EDIT, min_size=1, max_size=3))
    def trial(edits):
        path.write_bytes(whole)
        try:
            with h5py.File(path, "r+") as file:
                if not guarded:
                    del file.attrs["digest"]
                for one in edits:
                    edit(file, *one)
        except Exception:  # what the library does not let one write is no trial
            assume(False)
        found = outcome(Recording.load, path)
        if found is not None:
            usable(found, tmp_path)
            if guarded:
                same(found, expected)

    trial()


@sizes(60, 400)
@pytest.mark.parametrize("written", ["plain", "compressed", "version 4", "version 7.3"])
def test_damaged_mat_files(trials, written, tmp_path):
    path = tmp_path / "run.mat"
    columns = {"i": np.sin(TIME), "x": 1e-3 * np.cos(TIME)}
    if written == "version 7.3":
        with h5py.File(path, "w") as file:
            for name, values in columns.items():
                file.create_dataset(name, data=values[:, None], fletcher32=True).attrs["MATLAB_class"] = np.bytes_(
                    "double"
                )
    else:
        form = "4" if written == "version 4" else "5"
        scipy.io.savemat(path, columns, do_compression=written == "compressed", format=form)
    whole = path.read_bytes()
    options = {"channels": {"current": "i", "cart_position": "x"}, "sample_time": 1e-2, "kind": "forced"}
    expected = Recording.from_mat(path, **options)

    @fuzz(trials, damage=DAMAGE)
    def trial(damage):
        path.write_bytes(damaged(whole, damage))
        found = outcome(Recording.from_mat, path, **options)
        if found is not None:
            usable(found, tmp_path)
            if written in ("compressed", "version 7.3") and damage[0] == "bits":  # the samples have a checksum there
                assert found == expected

    trial()


CELLS = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False).map(repr),
    st.sampled_from(["", "nan", " 1.5 ", "1e400", "-inf", "1_5", "1,5", '"3"', "0x10", "text", "1e-400", "−1"]),
)


@sizes(120, 700)
def test_tables_that_anybody_may_have_written(trials, tmp_path):
    path = tmp_path / "run.csv"

    @fuzz(
        trials,
        names=st.lists(st.one_of(st.sampled_from(["t", "i", "x"]), printable(1, 5)), min_size=1, max_size=4),
        draw=st.data(),
        end=st.sampled_from(["\n", "\r\n", "\n\n", ""]),
        delimiter=st.sampled_from([",", ";", "\t", "", "ab", '"']),
        unit=st.sampled_from(["m", "mm", "in", "kg", "", None]),
        time=st.sampled_from([None, "t", "i"]),
        sample_time=st.one_of(st.none(), ODD),
        bounds=st.tuples(st.integers(-2, 20), st.one_of(st.none(), st.integers(-2, 20))),
        scale=st.one_of(st.none(), ODD),
    )
    def trial(names, draw, end, delimiter, unit, time, sample_time, bounds, scale):
        rows = draw.draw(st.lists(st.lists(CELLS, min_size=len(names), max_size=len(names)), max_size=16))
        text = end.join(delimiter.join(row) for row in [names, *rows])
        path.write_bytes(draw.draw(st.sampled_from([text.encode(), text.encode("utf-16"), text.encode()[1:]])))
        found = outcome(
            Recording.from_csv, path, channels={"cart_position": "x"}, kind="free", delimiter=delimiter, time=time,
            sample_time=sample_time, units=None if unit is None else {"cart_position": unit}, start=bounds[0], stop=bounds[1],
            scale=None if scale is None else {"cart_position": scale},
        )  # fmt: skip
        if found is not None:
            usable(found, tmp_path)

    trial()


@sizes(60, 300)
def test_a_table_of_numbers_is_read_as_it_stands(trials, tmp_path):
    path = tmp_path / "run.csv"
    cell = st.one_of(st.none(), st.floats(-1e6, 1e6, allow_subnormal=False))

    @fuzz(
        trials,
        rows=st.lists(st.tuples(cell, st.floats(-1e3, 1e3)), min_size=8, max_size=30),
        unit=st.sampled_from([("m", 1.0), ("mm", 1e-3), ("cm", 1e-2)]),
        delimiter=st.sampled_from([",", ";", "\t"]),
    )
    def trial(rows, unit, delimiter):
        lines = [delimiter.join(("" if x is None else repr(x), repr(i))) for x, i in rows]
        path.write_text("\n".join([f"x{delimiter}i", *lines]), encoding="utf-8")
        found = outcome(
            Recording.from_csv, path, channels={"cart_position": "x", "current": "i"}, kind="forced", sample_time=1e-2,
            units={"cart_position": unit[0]}, delimiter=delimiter,
        )  # fmt: skip
        if found is not None:
            expected = [np.nan if x is None else x * unit[1] for x, _ in rows]
            np.testing.assert_array_equal(found["run"].outputs["cart_position"].values, expected)
            np.testing.assert_array_equal(found["run"].inputs["current"].values, [i for _, i in rows])

    trial()


VALUES = st.one_of(
    SAMPLES.filter(lambda values: not isinstance(values, (list, float))),
    st.lists(st.one_of(st.floats(), st.none()), max_size=30),
    st.sampled_from(["text", None, 1.0, {}, [[1.0], [2.0, 3.0]], ["a"], np.array([None] * 20)]),
)


NOISES = st.dictionaries(st.sampled_from([*OUTPUTS, "odd"]), ODD, max_size=2)
CONSTANTS = st.dictionaries(st.one_of(st.sampled_from(["total_mass", "arm_inertia", "odd"]), NAMES), ODD, max_size=2)
ODDITIES = {
    "name": NAMES,
    "kind": st.sampled_from(["free", "rest", "odd", None]),
    "sample_time": ODD,
    **dict.fromkeys([*INPUTS, *OUTPUTS], VALUES),
    "initial_arm_angle": ODD,
    "arm": st.sampled_from(["locked", 1, "Free"]),
    "cart": st.sampled_from(["clamped", None]),
    "noise_std": NOISES,
    "intersample": st.sampled_from(["bl", "foh", "linear", {"odd": "zoh"}]),
    "repeat_of": st.one_of(st.just("free_1"), NAMES),
}
REST = {"rig": CONSTANTS, "comment": st.one_of(printable(), st.sampled_from([None, 1, "\0"])), "rig_name": NAMES}


@st.composite
def options(draw, usual, odd):
    """What is usual, with up to two oddities."""
    for key in draw(st.lists(st.sampled_from(sorted(odd)), max_size=2, unique=True)):
        usual = usual | {key: draw(odd[key])}
    return usual


USUAL = {
    "name": "forced_1",
    "kind": "forced",
    "sample_time": 1e-2,
    "current": np.cos(TIME),
    "cart_position": np.sin(TIME),
}


@sizes(150, 900)
def test_experiments_of_anything(trials, tmp_path):
    accepted = []

    @fuzz(trials, given_options=options(USUAL, ODDITIES), rest=options({"rig": {}}, REST))
    def trial(given_options, rest):
        experiment = outcome(Experiment.of, **given_options)
        found = None if experiment is None else outcome(Recording, (experiment,), **rest)
        accepted.append(found is not None)
        if found is not None:
            usable(found, tmp_path)
            outcome(found.split)

    trial()
    assert 0.1 < np.mean(accepted) < 0.9
