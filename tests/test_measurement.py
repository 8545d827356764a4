"""Experiments, recordings, imports, filters and excitation."""

import copy
import pickle
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io

from rtac_jax.measurement import (
    OUTPUTS,
    Experiment,
    Recording,
    RecordingError,
    Signal,
    central_difference,
    chirp,
    concerns,
    describe,
    multisine,
    prbs,
    square_wave,
    zero_phase_lowpass,
)

SILVERBOX = Path(__file__).parents[2] / "shared" / "data" / "silverbox" / "SNLS80mV.mat"
DT = 2e-3
T = np.arange(2000) * DT
DECAY = 15e-3 * np.exp(-0.3 * T) * np.cos(10.4 * T)


def noise(seed, std=1e-5):
    return std * np.random.default_rng(seed).standard_normal(len(T))


def free(name="free", **options):
    given = {"kind": "free", "sample_time": DT, "cart_position": DECAY, **options}
    return Experiment.of(name, **given)


def forced(name="forced", **options):
    given = {"current": np.sin(8 * T), "arm_velocity": np.sin(8 * T + 1), "cart_position": DECAY}
    return Experiment.of(name, **{"kind": "forced", "sample_time": DT, **given, **options})


def rest(name="rest"):
    return Experiment.of(name, kind="rest", sample_time=DT, cart_position=noise(0), arm_velocity=0 * T)


def spoilt(values, index, value):
    values = np.array(values)
    values[index] = value
    return values


# Experiment


def test_experiment_keeps_what_it_was_given():
    experiment = forced(
        disturbance_force=T,
        intersample={"current": "bl"},
        noise_std={"cart_position": 1e-5},
        initial_arm_angle=1,
    )
    assert experiment.samples == 2000
    assert experiment.duration == pytest.approx(4.0)
    np.testing.assert_allclose(experiment.time, T)
    assert list(experiment.inputs) == ["current", "disturbance_force"]
    assert list(experiment.outputs) == ["cart_position", "arm_velocity"]
    assert experiment.inputs["current"].intersample == "bl"
    assert experiment.inputs["disturbance_force"].intersample == "zoh"
    assert experiment.outputs["cart_position"].noise_std == 1e-5
    assert experiment.outputs["cart_position"].unit == OUTPUTS["cart_position"]


def test_experiment_does_not_change_with_the_arrays_it_was_made_of():
    values = DECAY.copy()
    experiment = free(cart_position=values)
    values[:] = 0
    np.testing.assert_array_equal(experiment.outputs["cart_position"].values, DECAY)
    with pytest.raises(ValueError, match="read-only"):
        experiment.outputs["cart_position"].values[0] = 1.0
    with pytest.raises(TypeError):
        experiment.outputs["arm_angle"] = experiment.outputs["cart_position"]


def test_experiments_compare_copy_and_pickle_by_value():
    gap = free(cart_position=spoilt(DECAY, 3, np.nan))
    assert gap == free(cart_position=spoilt(DECAY, 3, np.nan))
    assert gap != free()
    assert pickle.loads(pickle.dumps(gap)) == copy.deepcopy(gap) == gap
    recording = Recording((gap, rest()), {"total_mass": 1.0})
    assert pickle.loads(pickle.dumps(recording)) == recording
    assert hash(gap) == hash(copy.copy(gap))


def test_cut():
    experiment = forced(initial_arm_angle=0.5, noise_std={"cart_position": 1e-5})
    late = experiment.cut(100, 300)
    assert late.name == "forced[100:300]"
    assert late.initial_arm_angle is None
    assert late.outputs["cart_position"].noise_std == 1e-5
    np.testing.assert_array_equal(late.inputs["current"].values, np.sin(8 * T)[100:300])
    assert experiment.cut(0, 300, "early").initial_arm_angle == 0.5
    with pytest.raises(ValueError, match=r"/experiments/forced: cannot cut samples 10 to 5000.*2000"):
        experiment.cut(10, 5000)


def test_what_is_held_may_stand_still():
    forced(cart="clamped", cart_position=0 * T)
    free(arm="locked", arm_velocity=0 * T, arm_angle=0 * T)
    rest()


REFUSED = {
    "kind": ({"kind": "driven"}, r"/experiments/x: kind is 'driven'.*'free', 'forced', 'rest'"),
    "arm": ({"arm": "stuck"}, r"/experiments/x: arm is 'stuck'.*'free', 'locked'"),
    "cart": ({"cart": 1}, r"/experiments/x: cart is 1.*'clamped'"),
    "intersample": ({"intersample": "foo"}, r"/experiments/x/inputs/current: intersample is 'foo'.*'zoh'"),
    "intersample channel": ({"intersample": {"torque": "bl"}}, r"/experiments/x: intersample names 'torque'"),
    "zero sample time": ({"sample_time": 0}, r"/experiments/x: sample_time \[s\] is 0, but must be positive"),
    "NaN sample time": ({"sample_time": np.nan}, r"/experiments/x: sample_time \[s\] is nan"),
    "text sample time": ({"sample_time": "1"}, r"/experiments/x: sample_time \[s\] is '1'"),
    "angle": ({"initial_arm_angle": np.inf}, r"/experiments/x: initial_arm_angle \[rad\] is inf"),
    "length": (
        {"current": T[1:]},
        r"/experiments/x/inputs/current: has 1999 samples.*cart_position has 2000",
    ),
    "NaN current": ({"current": spoilt(T, 7, np.nan)}, r"/experiments/x/inputs/current, sample 7: .* nan"),
    "infinite current": (
        {"current": spoilt(T, 8, np.inf)},
        r"/experiments/x/inputs/current, sample 8: .* inf",
    ),
    "infinite output": (
        {"cart_position": spoilt(T, 9, -np.inf)},
        r"/experiments/x/outputs/cart_position, sample 9: .*-inf",
    ),
    "all NaN": (
        {"arm_velocity": np.nan * T},
        r"/experiments/x/outputs/arm_velocity: all 2000 samples are missing",
    ),
    "constant": ({"arm_velocity": 0 * T + 3}, r"/experiments/x/outputs/arm_velocity: all samples are 3"),
    "no output": ({"arm_velocity": None, "cart_position": None}, r"/experiments/x/outputs: is empty"),
    "idle": ({"current": 0 * T}, r"/experiments/x/inputs: a forced experiment needs an input"),
    "noise": ({"noise_std": {"arm_velocity": 0.0}}, r"/experiments/x/outputs/arm_velocity: noise_std is 0"),
    "noise channel": ({"noise_std": {"current": 1.0}}, r"/experiments/x: noise_std names 'current'"),
    "2-D": ({"current": np.ones((2000, 1))}, r"/experiments/x/inputs/current: .*\(2000, 1\)"),
    "text": ({"current": ["a"] * 2000}, r"/experiments/x/inputs/current: .*dtype <U1"),
    "complex": ({"current": T + 1j}, r"/experiments/x/inputs/current: .*complex128"),
    "itself": ({"repeat_of": "x"}, r"/experiments/x: repeat_of is 'x'"),
}


@pytest.mark.parametrize(("options", "message"), REFUSED.values(), ids=REFUSED)
def test_experiment_refuses(options, message):
    with pytest.raises(RecordingError, match=message) as caught:
        forced("x", **options)
    assert str(caught.value).endswith(".")


def test_three_samples_are_refused():
    with pytest.raises(ValueError, match=r"/experiments/x/outputs/cart_position: has 3 samples.*at least 8"):
        free("x", cart_position=[1.0, 2.0, 3.0])


@pytest.mark.parametrize("name", ["", "a/b", ".", "a\0b", "a\nb", 3])
def test_bad_names_are_refused(name):
    with pytest.raises(ValueError, match=r"/experiments: an experiment is named .*without '/'"):
        free(name)


def test_wrong_units_and_channels_are_refused():
    def build(inputs, outputs):
        return Experiment("x", "forced", DT, inputs, outputs)

    current, position = Signal(np.sin(T), "A", "zoh"), Signal(DECAY, "m")
    build({"current": current}, {"cart_position": position})
    with pytest.raises(ValueError, match="/experiments/x/outputs/cart_position: the unit is 'mm', but 'm'"):
        build({"current": current}, {"cart_position": replace(position, unit="mm")})
    with pytest.raises(ValueError, match=r"/experiments/x/inputs/voltage: there is no such channel.*current"):
        build({"voltage": current}, {"cart_position": position})
    with pytest.raises(ValueError, match="/experiments/x/inputs/current: intersample is None"):
        build({"current": replace(current, intersample=None)}, {"cart_position": position})
    with pytest.raises(ValueError, match="/experiments/x/outputs/cart_position: an output has no intersample"):
        build({"current": current}, {"cart_position": replace(position, intersample="zoh")})
    with pytest.raises(ValueError, match=r"/experiments/x/outputs/cart_position: is a ndarray; wrap it in Signal"):
        build({"current": current}, {"cart_position": DECAY})


# Recording


def test_recording_gives_experiments_by_name_and_in_order():
    recording = Recording((forced(), free(), rest()))
    assert recording.names == ("forced", "free", "rest") == tuple(e.name for e in recording)
    assert len(recording) == 3
    assert recording["free"] == free()
    with pytest.raises(KeyError, match="no experiment 'fre'; there are forced, free, rest"):
        recording["fre"]


@pytest.mark.parametrize(
    ("experiments", "rig", "message"),
    [
        ((), {}, "/experiments: is empty"),
        ((free(), free()), {}, "/experiments/free: the name occurs twice"),
        ((free(repeat_of="b"),), {}, "/experiments/free: repeat_of is 'b', which is not in the recording"),
        (
            (free(), forced(repeat_of="free")),
            {},
            "/experiments/forced: repeat_of is 'free', but kind differs",
        ),
        (
            (forced(), forced("b", current=np.cos(T), repeat_of="forced")),
            {},
            "/experiments/b: repeat_of is 'forced', but inputs differs",
        ),
        (
            (free(), free("b", repeat_of="free"), free("c", repeat_of="b")),
            {},
            "/experiments/c: repeat_of is 'b', itself a repeat; name the original, 'free'",
        ),
        ((free(),), {"total_mass": -1.0}, "/rig/total_mass: the constant is -1, but must be positive"),
        ((free(),), {"drag": np.nan}, "/rig/drag: the constant is nan"),
        ((free(),), {"drag": "1"}, "/rig/drag: the constant is '1'"),
        ((free(),), {"a b": 1.0}, "/rig: a constant is named 'a b'"),
    ],
)
def test_recording_refuses(experiments, rig, message):
    with pytest.raises(RecordingError, match=message):
        Recording(experiments, rig)


def test_split_holds_out_every_fourth_of_each_kind_with_its_repeats():
    frees = [free(f"d{i}", cart_position=DECAY * (i + 1)) for i in range(9)]
    driven = [forced("f0"), forced("f1"), forced("f1 again", repeat_of="f1")]
    train, validation = Recording((*frees, rest(), *driven), {"total_mass": 1.0}).split()
    assert validation.names == ("d3", "d7", "f1", "f1 again")
    assert train.names == ("d0", "d1", "d2", "d4", "d5", "d6", "d8", "rest", "f0")
    assert train.rig == validation.rig == {"total_mass": 1.0}


def test_split_by_name_keeps_repeats_together():
    recording = Recording((forced(), forced("again", repeat_of="forced"), free(), rest()))
    for name in ("forced", "again"):
        train, validation = recording.split([name])
        assert train.names == ("free", "rest")
        assert validation.names == ("forced", "again")
    assert recording.split("free")[1].names == ("free",)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (None, "nothing can be held out of free, rest, .*Experiment.cut"),
        (["free"], "nothing is left for training besides free"),
        (["nil"], "/experiments/nil: was named for validation, but is not in the recording"),
        (["rest"], "/experiments/rest: is at rest and can validate nothing"),
        ([], "nothing can be held out"),
    ],
)
def test_split_refuses(names, message):
    with pytest.raises(ValueError, match=message):
        Recording((free(), rest())).split(names)


def test_select_lets_a_repeat_stand_alone():
    recording = Recording((forced(), forced("again", repeat_of="forced")))
    assert recording.select(["again"])["again"].repeat_of is None
    assert recording.select(["again", "forced"]) == recording


def test_join():
    first, second = (
        Recording((free(),), {"total_mass": 1.0}),
        Recording((rest(),), {"arm_inertia": 2.0}, "lab"),
    )
    joined = Recording.join(first, second)
    assert joined == Recording((free(), rest()), {"total_mass": 1.0, "arm_inertia": 2.0}, "lab")
    with pytest.raises(ValueError, match="/rig/total_mass: is 1 in one recording and 2 in another"):
        Recording.join(first, replace(second, rig={"total_mass": 2.0}))
    with pytest.raises(ValueError, match="/experiments/free: the name occurs twice"):
        Recording.join(first, first)


# MAT


def write_mat73(path, **variables):
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in variables.items():
            file[name] = values
            file[name].attrs["MATLAB_class"] = np.bytes_("char" if values.dtype.kind == "u" else "double")
    with open(path, "r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116))


CHANNELS = {"current": "i", "cart_position": "x"}


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
    assert not any("outliers" in sentence or "clipped" in sentence for sentence in concerns(recording))


# CSV


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
    ("row", "text", "options", "message"),
    [
        (5, "0.04;1;1,5;a", {}, r"run.csv: row 6, column 'x': '1,5' is not a number"),
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


# Filters


def test_lowpass_keeps_the_pass_band_in_phase_and_stops_the_rest():
    time = np.arange(4000) * 1e-3
    middle = slice(1000, 3000)
    low, high = np.sin(2 * np.pi * 5 * time + 0.3), np.sin(2 * np.pi * 60 * time)
    result = zero_phase_lowpass(low + high, sample_time=1e-3, cutoff=20.0)
    # Twice the ripple of 0.05 dB is 1.2 %; a delay of one sample alone would leave 3 %.
    assert np.abs(result - low)[middle].max() < 0.012
    assert np.abs(zero_phase_lowpass(high, sample_time=1e-3, cutoff=20.0))[middle].max() < 1e-4
    quadrature = np.cos(2 * np.pi * 5 * time + 0.3)
    assert abs(np.mean(result[middle] * quadrature[middle])) < 1e-6


def test_lowpass_is_symmetric_in_time_and_exact_on_constants():
    values = DECAY + noise(1)
    forward = zero_phase_lowpass(values, sample_time=DT, cutoff=20.0)
    backward = zero_phase_lowpass(values[::-1], sample_time=DT, cutoff=20.0)[::-1]
    inside = slice(300, -300)
    np.testing.assert_allclose(forward[inside], backward[inside], atol=2e-6)
    np.testing.assert_allclose(zero_phase_lowpass(0 * T + 3, sample_time=DT, cutoff=20.0), 3.0, rtol=1e-9)


@pytest.mark.parametrize(
    ("values", "cutoff", "message"),
    [
        (T, 250.0, "cutoff: is 250 Hz, .*half the sampling rate, 250 Hz"),
        (T, -1.0, "cutoff: is -1 Hz"),
        (T[:30], 20.0, "values: has 30 samples, but this filter needs more than 30"),
        (spoilt(T, 4, np.nan), 20.0, "values, sample 4: is nan"),
        (T[:, None], 20.0, r"values: the shape is \(2000, 1\)"),
    ],
)
def test_lowpass_refuses(values, cutoff, message):
    with pytest.raises(ValueError, match=message):
        zero_phase_lowpass(values, sample_time=DT, cutoff=cutoff)


def test_central_difference_is_exact_on_parabolas():
    result = central_difference(3 * T**2 - 2 * T + 1, sample_time=DT)
    assert result.shape == (len(T) - 2,)
    np.testing.assert_allclose(result, (6 * T - 2)[1:-1], atol=1e-9)
    with pytest.raises(ValueError, match="values: has 2 samples"):
        central_difference(T[:2], sample_time=DT)


# Excitation


@pytest.mark.parametrize("seed", [None, 3])
def test_multisine_has_the_asked_spectrum(seed):
    wave = multisine(samples=1500, sample_time=DT, rms=0.3, band=(2.0, 10.0), period=500, seed=seed)
    assert wave.shape == (1500,)
    np.testing.assert_allclose(wave[:500], wave[1000:])
    size = np.abs(np.fft.rfft(wave[:500]))
    assert np.flatnonzero(size > 1e-9 * size.max()).tolist() == list(range(2, 11))
    np.testing.assert_allclose(size[2:11], size[2])
    assert np.sqrt(np.mean(wave**2)) == pytest.approx(0.3)
    again = multisine(samples=1500, sample_time=DT, rms=0.3, band=(2.0, 10.0), period=500, seed=seed)
    np.testing.assert_array_equal(wave, again)


def test_other_currents():
    square = square_wave(samples=1000, sample_time=DT, amplitude=0.5, frequency=5.0)
    np.testing.assert_array_equal(square, np.tile(np.repeat([0.5, -0.5], 50), 10))
    sweep = chirp(samples=1000, sample_time=DT, amplitude=0.5, band=(1.0, 10.0))
    assert np.abs(sweep).max() <= 0.5
    assert abs(sweep[0]) < 1e-12
    binary = prbs(samples=1000, hold=8, amplitude=0.5, seed=1)
    assert binary.shape == (1000,)
    assert set(binary) == {-0.5, 0.5}
    assert set(np.flatnonzero(np.diff(binary)) % 8) == {7}
    assert abs(binary.mean()) < 0.1


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: multisine(samples=100, sample_time=DT, rms=1.0), "harmonics, band: give one"),
        (
            lambda: multisine(samples=100, sample_time=DT, rms=1.0, harmonics=[50]),
            r"harmonics: \[50\] .*1 to 49",
        ),
        (lambda: multisine(samples=100, sample_time=DT, rms=0.0, harmonics=[1]), "rms: is 0"),
        (lambda: multisine(samples=100, sample_time=DT, rms=1.0, band=(1, 300)), "band: 300 Hz"),
        (
            lambda: square_wave(samples=100, sample_time=DT, amplitude=1.0, frequency=250.0),
            "frequency: 250 Hz",
        ),
        (lambda: chirp(samples=0, sample_time=DT, amplitude=1.0, band=(1, 2)), "samples: is 0"),
        (lambda: prbs(samples=10, hold=0, amplitude=1.0, seed=0), "hold: is 0"),
    ],
)
def test_excitation_refuses(call, message):
    with pytest.raises(ValueError, match=message):
        call()


# Description and concerns


def good():
    position = DECAY + noise(2)
    angle = forced(cart_position=position, arm_angle=T + noise(3), arm_velocity=np.sin(8 * T) + noise(4))
    return Recording((angle, rest("still")), {"total_mass": 1.2})


def test_describe():
    words = describe(replace(good(), rig_name="lab", comment="after oiling"))
    assert "rig: lab; known beforehand: total_mass = 1.2 kg" in words
    assert "comment: after oiling" in words
    assert "experiments: 2 (1 forced, 1 rest), 4000 samples, 8 s" in words
    assert "forced: forced; 2000 samples of 0.002 s, 4 s" in words
    assert any(line.split() == ["current", "A", "0.702", "0", "zoh"] for line in words.splitlines())


def test_a_good_recording_has_one_small_fault():
    assert concerns(good()) == [
        "still: arm_velocity is exactly constant, so it says nothing about the noise; check that the sensor "
        "was connected."
    ]


@pytest.mark.parametrize(
    ("experiment", "message"),
    [
        (free(), "There is no experiment at rest"),
        (free(), "The scale is not fixed"),
        (rest(), "All experiments are at rest"),
        (free(), "free: arm_angle was not measured"),
        (free(), "free: initial_arm_angle is not given"),
        (free(current=np.sin(T)), "an experiment of kind free has an input"),
        (free(arm="locked", cart="clamped"), "arm and cart are both held"),
        (forced(arm="locked"), "the current cannot move a locked arm"),
        (forced(cart="clamped", arm_velocity=None), "only what is held was measured"),
        (free().cut(0, 50), "fewer than 100 samples"),
        (free().cut(0, 50), "cart_position covers fewer than 3 periods"),
        (
            free(cart_position=np.sin(300 * T)),
            "cart_position is sampled fewer than 20 times in a period of its",
        ),
        (free(cart_position=np.clip(DECAY, -0.01, 0.01)), "cart_position stays repeatedly at exactly"),
        (
            free(cart_position=np.round(DECAY / 2e-4) * 2e-4),
            "cart_position is quantised in steps of 0.0002 m",
        ),
        (
            free(cart_position=spoilt(DECAY, slice(20), np.nan)),
            "cart_position has 1 % of its samples missing",
        ),
        (
            free(cart_position=spoilt(spoilt(DECAY + noise(5), 900, 5e-3), slice(20), np.nan)),
            "cart_position has 1 suspicious outliers, the first at sample 900",
        ),
    ],
)
def test_concerns(experiment, message):
    assert any(message in sentence for sentence in concerns(Recording((experiment,))))


def test_concerns_do_not_cry_wolf():
    stopped = np.where(T > 3, DECAY[1500], DECAY)
    kinked = np.cumsum(np.sign(np.sin(5 * T))) * DT + noise(6)
    for values in (DECAY, DECAY + noise(7), stopped, kinked):
        words = " ".join(concerns(Recording((free(cart_position=values),))))
        assert "clipped" not in words
        assert "outliers" not in words
        assert "quantised" not in words
