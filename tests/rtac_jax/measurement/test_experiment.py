"""Experiments and recordings: what they keep, refuse, split, select and join."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
from small_experiments import DECAY, DT, T, forced, free, rest, spoilt

from rtac_jax.measurement import (
    OUTPUTS,
    Experiment,
    Recording,
    RecordingError,
    Signal,
)


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


def test_the_last_quarter_of_an_only_forced_experiment_can_be_held_out():
    motion = {"cart_position": np.sin(0.01 * np.arange(2000)), "current": np.ones(2000)}
    only = Experiment.of("long", kind="forced", sample_time=0.001, initial_arm_angle=0.3, **motion)
    divided = Recording((only, rest()), {"total_mass": 1.0}).divided()
    train, validation = divided.split()
    assert train.names == ("long[0:1500]", "rest")
    assert validation.names == ("long[1500:2000]",)
    assert divided.rig == {"total_mass": 1.0}
    assert (divided["long[0:1500]"].initial_arm_angle, divided["long[1500:2000]"].initial_arm_angle) == (0.3, None)
    for several in ((only, free()), (only.cut(0, 199), rest())):
        recording = Recording(several)
        assert recording.divided() is recording


@pytest.mark.parametrize(("decay", "lively"), [(1e-3, True), (1e-2, False)])
def test_the_last_quarter_of_an_only_decay_can_be_held_out_if_it_still_moves(decay: float, lively: bool) -> None:
    number = np.arange(400)
    swing = 0.3 * np.exp(-decay * number) * np.cos(0.2 * number)
    recording = Recording((Experiment.of("swing", kind="free", sample_time=0.03, cart="clamped", arm_angle=swing),))
    assert (recording.divided() is not recording) is lively
    if lively:
        assert [part.names for part in recording.divided().split()] == [("swing[0:300]",), ("swing[300:400]",)]


@pytest.mark.parametrize(("falls", "lively"), [(0.4, True), (0.95, False)])
def test_a_wheel_that_coasts_moves_though_its_speed_hardly_changes(falls: float, lively: bool) -> None:
    speed = 12.8 * (1 - falls * np.arange(400) / 400)
    recording = Recording((Experiment.of("coast", kind="free", sample_time=0.01, cart="clamped", arm_velocity=speed),))
    assert (recording.divided() is not recording) is lively


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
