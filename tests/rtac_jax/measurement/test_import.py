"""Recordings from MAT and CSV files."""

from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
from small_experiments import DECAY, DT, T, spoilt

import rtac_jax as rtac
from rtac_jax.measurement import (
    Recording,
    RecordingError,
    _clock,
    concerns,
    describe,
)

SILVERBOX = Path(__file__).parents[4] / "shared" / "data" / "silverbox" / "SNLS80mV.mat"


def write_mat73(path, **variables):
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in variables.items():
            file[name] = values
            file[name].attrs["MATLAB_class"] = np.bytes_("char" if values.dtype.kind == "u" else "double")
    with open(path, "r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116))


CHANNELS = {"current": "i", "cart_position": "x"}


@pytest.mark.parametrize(("beginning", "turns"), [(None, 1), (-0.5, 0), (-0.5 + 4 * np.pi, 2)])
def test_an_encoder_that_begins_again_after_a_turn(tmp_path, beginning, turns):
    """In degrees from 0 to 360, with samples missing at the jumps; on the turn on which the arm is said to begin."""
    angle = -0.5 + 9.0 * np.sin(0.7 * T)
    wrapped = np.mod(np.degrees(angle), 360.0)
    wrapped[np.flatnonzero(np.abs(np.diff(wrapped)) > 300)] = np.nan
    path = tmp_path / "run.csv"
    np.savetxt(path, np.column_stack([np.sin(T), wrapped]), delimiter=",", header="i,th", comments="")
    options = dict(
        channels={"current": "i", "arm_angle": "th"}, kind="forced", sample_time=DT, units={"arm_angle": "deg"}
    )
    whole = (
        Recording.from_csv(path, **options, unwrap=True, initial_arm_angle=beginning)["run"].outputs["arm_angle"].values
    )
    kept = np.isfinite(wrapped)
    assert np.sum(~kept) > 2
    np.testing.assert_allclose(whole[kept], (angle + 2 * np.pi * turns)[kept], atol=1e-9)
    assert np.array_equal(np.isnan(whole), ~kept)
    as_it_is = Recording.from_csv(path, **options)["run"].outputs["arm_angle"].values
    np.testing.assert_allclose(as_it_is[kept], np.radians(wrapped[kept]))


@pytest.mark.parametrize("version", ["5", "7.3"])
@pytest.mark.parametrize("shape", [(1, -1), (-1, 1)])
def test_mat(tmp_path, version, shape):
    path = tmp_path / "run.mat"
    columns = {"i": np.sin(T).reshape(shape), "x": 1e3 * DECAY.reshape(shape), "t": (5 + T).reshape(shape)}
    scipy.io.savemat(path, columns) if version == "5" else write_mat73(path, **columns)
    recording = Recording.from_mat(
        path,
        channels=CHANNELS,
        time="t",
        kind="forced",
        units={"cart_position": "mm"},
        rig={"total_mass": 1.2},
    )
    experiment = recording["run"]
    assert experiment.sample_time == pytest.approx(DT, rel=1e-12)
    assert recording.rig == {"total_mass": 1.2}
    np.testing.assert_array_equal(experiment.inputs["current"].values, np.sin(T))
    np.testing.assert_allclose(experiment.outputs["cart_position"].values, DECAY, rtol=1e-15)


def test_import_cuts_scales_and_removes_the_mean(tmp_path):
    scipy.io.savemat(tmp_path / "run.mat", {"i": np.sin(T), "x": 2 + DECAY})
    experiment = Recording.from_mat(
        tmp_path / "run.mat",
        channels=CHANNELS,
        sample_time=DT,
        kind="forced",
        name="part",
        scale={"current": -0.5},
        start=100,
        stop=300,
        remove_mean=["cart_position"],
        intersample="bl",
    )["part"]
    np.testing.assert_allclose(experiment.inputs["current"].values, -0.5 * np.sin(T[100:300]))
    np.testing.assert_allclose(
        experiment.outputs["cart_position"].values, DECAY[100:300] - DECAY[100:300].mean(), atol=1e-15
    )
    assert experiment.inputs["current"].intersample == "bl"


@pytest.mark.parametrize("version", ["5", "7.3"])
@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        ({}, {"channels": {"cart_position": "y"}}, r"run.mat: y: there is no such variable; the file has"),
        ({"x": np.ones((1000, 2))}, {}, r"run.mat: x: the shape is \(\d+, \d+\), but a vector"),
        (
            {"x": np.zeros(2000, dtype=np.uint16)},
            {},
            r"run.mat: (x: is a MATLAB char|.*cart_position: all samples)",
        ),
        ({"t": spoilt(T, 50, 0.0)}, {}, r"run.mat: t, index 50: the time does not increase"),
        (
            {"t": np.where(T > 1, T + 0.1, T)},
            {},
            r"run.mat: t, index 501: the step is 0.102 s and elsewhere 0.002 s",
        ),
        ({"x": T[1:]}, {}, r"run.mat: the lengths differ"),
        ({}, {"units": {"cart_position": "V"}}, r"units/cart_position: 'V' is not known.*scale="),
        ({}, {"scale": {"cart_position": 0.0}}, r"scale/cart_position: .* is 0, but must be positive"),
        ({}, {"stop": 5000}, r"samples 0 to 5000 were asked for; .* 2000"),
        ({}, {"sample_time": 1.0}, r"time, sample_time: give one of the two"),
        ({}, {"remove_mean": ["arm_angle"]}, r"remove_mean: names 'arm_angle'"),
        ({}, {"channels": {"force": "x"}}, r"channels: there is no channel 'force'"),
    ],
)
def test_mat_refuses(tmp_path, version, change, options, message):
    path = tmp_path / "run.mat"
    columns = {"i": np.sin(T), "x": DECAY, "t": T, **change}
    scipy.io.savemat(path, columns) if version == "5" else write_mat73(path, **columns)
    with pytest.raises(RecordingError, match=message):
        Recording.from_mat(path, **{"channels": CHANNELS, "time": "t", "kind": "forced", **options})


def test_mat_refuses_a_file_that_is_none(tmp_path):
    path = tmp_path / "run.mat"
    with pytest.raises(FileNotFoundError, match=r"run.mat: there is no such file"):
        Recording.from_mat(path, channels=CHANNELS, sample_time=DT, kind="forced")
    scipy.io.savemat(path, {"i": np.sin(T), "x": DECAY}, do_compression=True)
    whole = path.read_bytes()
    for part in (b"", b"nothing of the kind" * 100, whole[:200], whole[: len(whole) // 2], whole[:-10]):
        path.write_bytes(part)
        with pytest.raises(RecordingError, match=r"run.mat: .*(not a MAT file|damaged|no such variable)"):
            Recording.from_mat(path, channels=CHANNELS, sample_time=DT, kind="forced")


@pytest.mark.skipif(not SILVERBOX.exists(), reason="the Silverbox data is not beside the project")
def test_silverbox():
    recording = Recording.from_mat(
        SILVERBOX,
        channels={"disturbance_force": "V1", "cart_position": "V2"},
        sample_time=2**14 / 1e7,
        kind="forced",
        start=40650,
        stop=105712,
        intersample="bl",
        arm="locked",
    )
    experiment = recording["SNLS80mV"]
    assert experiment.samples == 65062
    raw = scipy.io.loadmat(SILVERBOX)
    np.testing.assert_array_equal(experiment.outputs["cart_position"].values, raw["V2"][0, 40650:105712])
    assert "SNLS80mV: forced; 65062 samples" in describe(recording)
    assert not any("outliers" in sentence or "range of the sensor" in sentence for sentence in concerns(recording))


def write_csv(path, *rows):
    path.write_text("\n".join(rows) + "\n", encoding="utf-8-sig")
    return path


ROWS = ["t; i_motor ; x ; note", *(f"{0.01 * n:.2f};{n % 3};{n * n};a" for n in range(10))]


def load_csv(path, **options):
    given = {"channels": {"current": "i_motor", "cart_position": "x"}, "time": "t", "delimiter": ";"}
    return Recording.from_csv(path, **{**given, "kind": "forced", **options})


def test_csv(tmp_path):
    rows = [*ROWS[:4], "0.03;0;;a", "0.04;1;nan;a", *ROWS[6:], "", ""]
    experiment = load_csv(write_csv(tmp_path / "run.csv", *rows))["run"]
    assert experiment.sample_time == pytest.approx(0.01)
    np.testing.assert_array_equal(experiment.inputs["current"].values, np.arange(10) % 3)
    expected = np.arange(10.0) ** 2
    expected[3:5] = np.nan
    np.testing.assert_array_equal(experiment.outputs["cart_position"].values, expected)


@pytest.mark.parametrize(
    ("column", "options", "factor"),
    [
        ("x [mm]", {}, 1e-3),
        ("x (mm)", {}, 1e-3),
        ("x_mm", {}, 1e-3),
        ("x [inches]", {}, 0.0254),
        ("x (Millimeters)", {}, 1e-3),
        ("x_second", {}, 1.0),  # of two
        ("x_cm", {}, 1.0),  # the centre of mass, rather
        ("x_rpm", {}, 1.0),  # no unit of a length
        ("Cart_Position(mm)", {}, 1e-3),
        ("Position in mm", {}, 1e-3),
        ("Position in all", {}, 1.0),
        ("x [mm]", {"units": {"cart_position": "m"}}, 1.0),
        ("x [mm]", {"units": {"cart_position": "cm"}}, 1e-2),
        ("x [V]", {"scale": {"cart_position": 0.02}}, 0.02),
    ],
)
def test_a_unit_that_the_name_of_a_column_states_is_that_of_its_numbers(tmp_path, column, options, factor):
    rows = [f"t [ms];i_motor;{column}", *(f"{10 * n};{n % 3};{n * n}" for n in range(10))]
    path = write_csv(tmp_path / "run.csv", *rows)
    channels = {"current": "i_motor", "cart_position": column}
    found = load_csv(path, channels=channels, time="t [ms]", **options)["run"]
    assert found.sample_time == pytest.approx(0.01)
    np.testing.assert_allclose(found.outputs["cart_position"].values, factor * np.arange(10.0) ** 2, rtol=1e-14)


def test_units_that_are_written_out_are_understood(tmp_path):
    rows = ["time (millisec);angle (degree);speed [degrees/sec];amps", *(f"{5 * n};{n};{n};{n % 2}" for n in range(10))]
    channels = {"arm_angle": "angle (degree)", "arm_velocity": "speed [degrees/sec]", "current": "amps"}
    path = write_csv(tmp_path / "run.csv", *rows)
    found = load_csv(path, channels=channels, time="time (millisec)", cart="clamped", initial_arm_angle=0.0)["run"]
    assert found.sample_time == pytest.approx(0.005)
    for channel in ("arm_angle", "arm_velocity"):
        np.testing.assert_allclose(found.outputs[channel].values, np.radians(np.arange(10.0)), rtol=1e-14)


@pytest.mark.parametrize(
    ("column", "time", "message"),
    [
        ("x [V]", "t", r"csv: column 'x \[V\]': 'V' is not known for cart_position, only m, .*; give scale=\{'cart_pos"),
        ("x (rpm)", "t", r"'rpm' is not known for cart_position, .*, or units=\{'cart_position': 'm'\} if that is what"),
        ("x", "t [min]", r"column 't \[min\]': 'min' is not known for time, only s, ms, us; give sample_time instead, or units="),
    ],
)  # fmt: skip
def test_a_column_that_states_a_unit_of_something_else_is_refused(tmp_path, column, time, message):
    path = write_csv(tmp_path / "run.csv", f"{time};i_motor;{column}", *(f"{n};{n % 3};{n * n}" for n in range(10)))
    with pytest.raises(RecordingError, match=message):
        load_csv(path, channels={"current": "i_motor", "cart_position": column}, time=time)


@pytest.mark.parametrize(
    ("row", "text", "options", "message"),
    [
        (5, "0.04;1;1_5;a", {}, r"run.csv: row 6, column 'x': '1_5' is not a number"),
        (5, "0.04;1;2", {}, r"run.csv: row 6: has 3 cells, but the header has 4"),
        (5, "", {}, r"run.csv: row 6: is empty"),
        (5, "0.04;;2;a", {}, r"run.csv: /experiments/run/inputs/current, sample 4: .* nan"),
        (5, "0.01;1;2;a", {}, r"run.csv: t, index 4: the time does not increase"),
        (5, ";1;2;a", {}, r"run.csv: t, index 4: the time does not increase"),
        (5, "0.0401;1;2;a", {}, r"run.csv: t, index 4: the step is 0.0101 s"),
        (0, "t;i_motor;x;x", {}, r"run.csv: row 1: the column 'x' occurs more than once"),
        (0, "0.0;1;2;3", {}, r"run.csv: row 1: the column 'i_motor' does not occur in the header"),
        (0, ROWS[0], {"delimiter": ","}, r"run.csv: row 1: the column 'i_motor' does not occur"),
        (0, ROWS[0], {"delimiter": "::"}, r"delimiter: is '::'"),
    ],
)
def test_csv_refuses(tmp_path, row, text, options, message):
    rows = list(ROWS)
    rows[row] = text
    with pytest.raises(RecordingError, match=message):
        load_csv(write_csv(tmp_path / "run.csv", *rows), **options)


def test_csv_refuses_a_file_that_is_none(tmp_path):
    path = tmp_path / "run.csv"
    with pytest.raises(FileNotFoundError, match=r"run.csv: there is no such file"):
        load_csv(path)
    path.write_bytes(b"\xff\xfe\x00\x01" * 50)
    with pytest.raises(RecordingError, match=r"run.csv: this is not a readable text file"):
        load_csv(path)


@pytest.mark.parametrize(
    ("rate", "digits", "read"),
    [(255.0, 6, True), (750.0, 6, True), (255.0, 4, True), (60.0, 3, True), (60.0, 2, False)],
)
def test_times_that_a_logger_rounds_are_those_of_its_clock(rate, digits, read):
    times = np.round(np.arange(3000) / rate, digits)
    if read:
        assert _clock.uniform_step(times, "t", 0) == pytest.approx(1 / rate, rel=1e-5)
    else:
        with pytest.raises(rtac.RecordingError, match="or give sample_time if the times are only rounded"):
            _clock.uniform_step(times, "t", 0)


def test_a_lost_sample_is_no_rounding():
    times = np.delete(np.arange(3000) / 255.0, 1500)
    with pytest.raises(rtac.RecordingError, match="t, index 1500: the step is"):
        _clock.uniform_step(np.round(times, 6), "t", 0)
