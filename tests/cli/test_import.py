"""`rtac import`: the numbers of a data logger's files, in the units of a recording, and what it does not understand."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io
from command_line import call, refused

from rtac_jax.measurement import Recording

TIME = 0.005 * np.arange(300)
POSITION = 0.009 * np.cos(10 * TIME)
SPEED = 20 * np.sin(7 * TIME)
CURRENT = 0.3 * np.sin(5 * TIME)
FREE = ("--kind", "free", "--channel", "cart_position=x [mm]", "--time", "t")


def write(path, **columns):
    """A CSV file whose columns are named with `__` where a name has a space, and units in brackets."""
    rows = [",".join(columns), *(",".join(map(repr, row)) for row in np.column_stack(list(columns.values())).tolist())]
    path.write_text("\n".join(rows) + "\n")
    return path


@pytest.fixture
def free(tmp_path):
    return write(tmp_path / "free_1.csv", **{"t": TIME, "x": 1e3 * POSITION})


@pytest.fixture
def forced(tmp_path):
    columns = {"t [ms]": 1e3 * TIME, "x [mm]": 1e3 * POSITION, "n": SPEED * 30 / np.pi, "i": 1e3 * CURRENT}
    return write(tmp_path / "forced_1.csv", **columns)


def imported(out, *arguments):
    result = call("import", *arguments, out)
    assert result.exit_code == 0, result.output
    return result, Recording.load(out)


def test_several_files_become_one_recording_in_its_units(tmp_path, free, forced):
    result, recording = imported(
        tmp_path / "rig.h5", free, forced, *["--kind", "free", "--kind", "forced", "--rig", "total_mass=1.23", "--angle", "0.5"],
        "--channel", "cart_position=x", "--channel", "arm_velocity=n [rpm]", "--channel", "current=i [mA]", "--time", "t",
        "--scale", "cart_position=0.001", "--noise", "cart_position=2e-6", "--intersample", "current=bl",
    )  # fmt: skip
    assert recording.names == ("free_1", "forced_1")
    assert [e.kind for e in recording] == ["free", "forced"]
    assert recording.rig == {"total_mass": 1.23}
    for experiment in recording:
        np.testing.assert_allclose(experiment.outputs["cart_position"].values, POSITION, rtol=1e-12)
        assert experiment.initial_arm_angle == 0.5
        assert experiment.outputs["cart_position"].noise_std == 2e-6
    assert recording["free_1"].sample_time == pytest.approx(0.005)
    assert recording["forced_1"].sample_time == pytest.approx(0.005)  # its times are in ms, as its first row says
    np.testing.assert_allclose(recording["forced_1"].outputs["arm_velocity"].values, SPEED, rtol=1e-12)
    np.testing.assert_allclose(recording["forced_1"].inputs["current"].values, CURRENT, rtol=1e-12)
    assert recording["forced_1"].inputs["current"].intersample == "bl"
    assert "It has no column for arm_velocity, current." in result.stdout
    assert "written: " in result.stdout


def test_kinds_are_told_by_names(tmp_path, free, forced):
    told = [
        "--kind",
        "fr*=free",
        "--kind",
        "*.csv=forced",
        "--channel",
        "cart_position=x [mm]",
        "--channel",
        "current=i [mA]",
        "--time",
        "t",
    ]
    _, recording = imported(tmp_path / "rig.h5", free, forced, *told)
    assert [(e.name, e.kind) for e in recording] == [("free_1", "free"), ("forced_1", "forced")]
    none = call("import", free, forced, "--kind", "fr*=free", *told[4:], tmp_path / "no.h5")
    refused(none, 2, "--kind: no pattern of fr*=free matches forced_1.csv", "add one, as 'forced_1=free'")
    idle = call("import", free, forced, *told[:4], "--kind", "zzz*=rest", *told[4:], tmp_path / "no.h5")
    refused(idle, 2, "--kind: no file is left for zzz*; the first pattern that a name matches counts")


def test_a_dry_run_shows_what_was_understood_and_writes_nothing(tmp_path, free):
    result = call("import", free, *FREE, "--dry-run", tmp_path / "rig.h5")
    assert result.exit_code == 0, result.output
    (row,) = (line.split() for line in result.stdout.splitlines() if "cart_position" in line and "0.001" in line)
    assert row == ["x", "mm", "0.001", "cart_position", "m", "-0.009", "0.009"]
    assert "300 samples of 0.005 s" in result.stdout
    assert "No unit is stated of these: t in s by assumption" in result.stdout
    assert "which is no unit of" not in result.stdout
    assert "initial_arm_angle is not given" in result.stdout
    assert not (tmp_path / "rig.h5").exists()


@pytest.mark.parametrize(
    ("column", "factor"),
    [
        ("x (mm)", 1e-3),
        ("x (inch)", 0.0254),
        ("x_um", 1e-6),
        ("x_in", 1.0),  # what comes in
        ("x (in)", 0.0254),
        ("x (left)", 1.0),
        ("x_cm", 1.0),  # of the centre of mass
        ("x_rpm", 1.0),  # no unit of a length
        ("x (mm) [cm]", 1e-2),
    ],
)
def test_a_unit_at_the_end_of_a_name_is_that_of_the_column_and_it_is_said(tmp_path, free, column, factor):
    name = column.split(" [")[0]
    head, _, rows = free.read_text().partition("\n")
    file = tmp_path / "named.csv"
    file.write_text(",".join(name if cell == "x" else cell for cell in head.split(",")) + "\n" + rows)
    told = ("--kind", "free", "--time", "t", "--channel", f"cart_position={column}")
    result, recording = imported(tmp_path / "rig.h5", file, *told)
    np.testing.assert_allclose(recording["named"].outputs["cart_position"].values, factor * 1e3 * POSITION, rtol=1e-12)
    by_name = f"By their columns' names: {name} in " in result.stdout
    assumed = f"No unit is stated of these: {name} in m, t in s by assumption" in result.stdout
    assert (by_name, assumed) == (factor not in (1.0, 1e-2), factor == 1.0)


@pytest.mark.parametrize(
    ("name", "unit"), [("drive (V)", "V"), ("speed (steps/s)", "steps/s"), ("n (left)", ""), ("n", "")]
)
def test_a_unit_that_no_channel_has_is_told(tmp_path, forced, name, unit):
    file = tmp_path / "motor.csv"
    file.write_text(forced.read_text().replace(",n,", f",{name},"))
    told = ("--kind", "free", "--time", "t", "--channel", f"arm_velocity={name}")
    said = " ".join(call("import", file, *told, tmp_path / "rig.h5").stdout.split())
    words = f"{name!r} ends in {unit}, which is no unit of arm_velocity: it is read as rad/s"
    assert (words in said) is bool(unit)
    assert (f"give --scale arm_velocity=FACTOR, in rad/s per {unit}" in said) is bool(unit)


def test_speeds_in_names_and_a_unit_of_another_quantity(tmp_path, forced):
    factors = {"n (RPM)": np.pi / 30, "n_deg_s": np.pi / 180, "n_rad_s": 1.0, "n (U/min)": np.pi / 30}
    for number, (name, factor) in enumerate(factors.items()):
        file = tmp_path / f"named_{number}.csv"
        file.write_text(forced.read_text().replace(",n,", f",{name},"))
        told = ("--kind", "free", "--time", "t", "--channel", f"arm_velocity={name}")
        _, recording = imported(tmp_path / f"rig_{number}.h5", file, *told)
        expected = factor * SPEED * 30 / np.pi
        np.testing.assert_allclose(recording[file.stem].outputs["arm_velocity"].values, expected, rtol=1e-12)
    file.write_text(forced.read_text().replace(",n,", ",n (mm),"))
    result = call(
        "import", file, "--kind", "free", "--time", "t", "--channel", "arm_velocity=n (mm)", tmp_path / "no.h5"
    )
    refused(result, 2, "--channel arm_velocity: the unit 'mm' is not known for it")


def test_a_unit_in_the_first_row_need_not_be_repeated_but_not_contradicted(tmp_path, forced):
    arguments = (forced, "--kind", "free", "--time", "t")
    for wish in ("x", "x [mm]"):
        _, recording = imported(tmp_path / "rig.h5", *arguments, "--channel", f"cart_position={wish}", "--replace")
        np.testing.assert_allclose(recording["forced_1"].outputs["cart_position"].values, POSITION, rtol=1e-12)
    refused(
        call("import", *arguments, "--channel", "cart_position=x [m]", tmp_path / "no.h5"), 2,
        "says that x is in mm", "--channel cart_position says m",
    )  # fmt: skip


def test_brackets_with_nothing_in_them_state_no_unit(tmp_path, free):
    file = tmp_path / "bare.csv"
    head, _, rows = free.read_text().partition("\n")
    file.write_text(",".join("x []" if cell == "x" else cell for cell in head.split(",")) + "\n" + rows)
    for number, wish in enumerate(("x", "x []")):
        told = ("--kind", "free", "--time", "t", "--channel", f"cart_position={wish}")
        result, recording = imported(tmp_path / f"rig_{number}.h5", file, *told)
        np.testing.assert_allclose(recording["bare"].outputs["cart_position"].values, 1e3 * POSITION, rtol=1e-12)
        assert "x [] in m" in result.stdout


def test_a_mat_file_and_a_recording_join(tmp_path, free):
    imported(tmp_path / "rig.h5", free, *FREE)
    scipy.io.savemat(tmp_path / "forced_2.mat", {"V1": CURRENT, "V2": np.degrees(SPEED)})
    _, both = imported(
        tmp_path / "rig.h5", tmp_path / "rig.h5", tmp_path / "forced_2.mat", "--kind", "forced", "--sample-time", "0.005",
        "--channel", "current=V1", "--channel", "arm_velocity=V2 [deg/s]", "--name", "forced, slow",
    )  # fmt: skip
    assert both.names == ("free_1", "forced, slow")
    np.testing.assert_allclose(both["forced, slow"].outputs["arm_velocity"].values, SPEED, rtol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--channel", "cart_position=x [furlong]"), ("'furlong' is not known", "m, cm, mm", "--scale cart_position=")),
        (("--channel", "cart_position=y"), ("has no column 'y'", "the columns are t, x")),
        (("--channel", "cart_place=x"), ("no channel cart_place", "cart_position")),
        (("--channel", "cart_position"), ("write NAME=VALUE",)),
        (("--channel", "cart_position=x", "--channel", "cart_position=t"), ("twice",)),
        ((), ("say which column is which", "t, x")),
        (("--channel", "cart_position=x", "--rig", "total_mass=heavy"), ("'heavy'", "a number")),
        (("--channel", "cart_position=x", "--name", "a", "--name", "b"), ("2 times for 1 files",)),
        (("--channel", "cart_position=x", "--sample-time", "0.1"), ("give one of the two",)),
        (("--channel", "cart_position=x", "--noise", "current=1"), ("current",)),
    ],
)
def test_what_it_does_not_understand_is_one_sentence(tmp_path, free, arguments, words):
    refused(call("import", free, "--kind", "free", "--time", "t", *arguments, tmp_path / "out.h5"), 2, *words)
    assert not (tmp_path / "out.h5").exists()


def test_files_and_kinds_must_be_named(tmp_path, free):
    refused(call("import", *FREE, free), 2, "ends in .h5")
    refused(call("import", *FREE, tmp_path / "out.h5"), 2, "name the files to import")
    refused(call("import", *FREE, tmp_path / "none.csv", tmp_path / "out.h5"), 2, "none.csv: there is no such file")
    refused(call("import", *FREE[2:], free, tmp_path / "out.h5"), 2, "what kind of experiment")
    refused(call("import", "--kind", "fast", *FREE[2:], free, tmp_path / "out.h5"), 2, "'fast'", "'free'")
    refused(call("import", *FREE, free, free, tmp_path / "out.h5"), 2, "the name occurs twice")


def test_a_rest_record_needs_no_angle_where_each_of_the_others_has_its_own(tmp_path, free, forced):
    still = write(tmp_path / "still.csv", **{"t [ms]": 1e3 * TIME, "x [mm]": 1e-3 * POSITION})
    arguments = [
        *["--kind", "free", "--kind", "rest", "--kind", "forced"],
        "--channel",
        "cart_position=x",
        "--time",
        "t",
    ]
    _, recording = imported(
        tmp_path / "rig.h5", free, still, forced, *arguments, "--scale", "cart_position=0.001",
        "--channel", "current=i [mA]", "--angle", "0.4", "--angle", "2.6",
    )  # fmt: skip
    assert [e.initial_arm_angle for e in recording] == [0.4, None, 2.6]


@pytest.mark.parametrize(("mark", "shell"), [(";", '--delimiter ";"'), ("\t", "--delimiter $'\\t'")])
def test_another_delimiter_is_told(tmp_path, mark, shell):
    file = tmp_path / "logger.csv"
    file.write_text(mark.join(["t [s]", "x [mm]"]) + "\n" + mark.join(["0.0", "1.0"]) + "\n")
    result = call("import", file, "--kind", "free", "--channel", "cart_position=x", "--time", "t", tmp_path / "rig.h5")
    refused(result, 2, shell)


def test_a_constant_that_no_rig_has_is_refused_before_anything_is_written(tmp_path, free):
    result = call("import", free, *FREE, "--rig", "mass=0.94", tmp_path / "rig.h5")
    refused(result, 2, "/rig names mass, which this model does not have", "total_mass")
    assert not (tmp_path / "rig.h5").exists()


def test_a_repeat_and_the_doubt_of_an_angle_can_be_said(tmp_path, free, forced):
    again = tmp_path / "again.csv"
    again.write_text(free.read_text())
    arguments = [
        "--kind",
        "free",
        "--channel",
        "cart_position=x [mm]",
        "--time",
        "t",
        "--angle",
        "0.3",
        "--angle-std",
        "0.02",
    ]
    _, recording = imported(tmp_path / "rig.h5", free, again, *arguments, "--repeat-of", "again=free_1")
    assert [e.repeat_of for e in recording] == [None, "free_1"]
    assert [e.initial_arm_angle_std for e in recording] == [0.02, 0.02]
    more = write(tmp_path / "more.csv", **{"t": TIME, "x": 1e3 * POSITION})
    _, joined = imported(
        tmp_path / "joined.h5", tmp_path / "rig.h5", more, "--kind", "free", *arguments[2:-2], "--angle-std", "0.05"
    )
    assert [e.initial_arm_angle_std for e in joined] == [0.02, 0.02, 0.05], "what was known of others stays"
    result = call("import", free, again, *arguments, "--repeat-of", "again=nothing", tmp_path / "other.h5")
    refused(result, 2, "--repeat-of: there is no experiment nothing", "free_1")


def test_an_encoder_that_begins_again_is_unwrapped_where_it_is_asked(tmp_path):
    time = 0.01 * np.arange(200)
    angle = 6.0 * np.sin(2.0 * time)
    file = tmp_path / "arm.csv"
    np.savetxt(
        file, np.column_stack([time, np.mod(angle, 2 * np.pi)]), delimiter=",", header="t,th", comments="", fmt="%.9g"
    )
    told = ["--kind", "free", "--time", "t [s]", "--channel", "arm_angle=th [rad]", "--angle", "0"]
    result, recording = imported(tmp_path / "whole.h5", file, *told, "--unwrap")
    np.testing.assert_allclose(recording["arm"].outputs["arm_angle"].values, angle, atol=1e-7)
    assert "whole turn" not in result.stdout
    result, _ = imported(tmp_path / "wrapped.h5", file, *told)
    assert "unwrap it (rtac import --unwrap" in " ".join(result.stdout.split())


def test_a_row_of_units_below_the_names_is_taken(tmp_path: Path) -> None:
    file = tmp_path / "run.csv"
    rows = [f"{0.01 * n:.2f},{0.1 * (n % 3):.1f},{1.5 * n % 7:.1f}" for n in range(200)]
    file.write_text("\n".join(["t,i,x", "s,A,mm", *rows]))
    told = ("--channel", "current=i", "--channel", "cart_position=x", "--time", "t", "--kind", "forced")
    result, recording = imported(tmp_path / "rig.h5", file, *told)
    assert "by assumption" not in result.output
    found = recording["run"].outputs["cart_position"].values
    np.testing.assert_allclose(found, 1e-3 * (1.5 * np.arange(200) % 7), atol=6e-5)


def test_two_columns_of_one_name_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "run.csv"
    rows = [f"{0.01 * n:.2f},{n % 7},{n % 5},0.0" for n in range(200)]
    file.write_text("\n".join(["t [s],x [mm],n [rad/s],x [mm]", *rows]))
    told = ("--channel", "cart_position=x", "--channel", "arm_velocity=n", "--time", "t", "--kind", "free")
    words = "has 2 columns named 'x' (x [mm], x [mm]); rename all but one"
    refused(call("import", file, *told, tmp_path / "out.h5"), 2, words)
