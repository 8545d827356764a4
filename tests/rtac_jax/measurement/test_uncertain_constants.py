"""Standard deviations of known constants: kept in files, told in words, and refused where they are none."""

import dataclasses
import pickle

import numpy as np
import pytest

import rtac_jax as rtac
from rtac_jax.measurement import Experiment, Recording, RecordingError
from rtac_jax.measurement._digest import digest
from rtac_jax.virtual_rig import Rig, record, standard_plans

T = 0.01 * np.arange(50)
RIG = {"total_mass": 1.23, "total_mass_std": 1e-3, "arm_inertia": 9.5e-5}


def released(**more):
    return Experiment.of(
        "free_1", kind="free", sample_time=0.01, cart_position=np.cos(T), initial_arm_angle=0.5, **more
    )


UNCERTAIN = Recording((released(initial_arm_angle_std=0.02),), RIG)
EXACT = Recording((released(),), {"total_mass": 1.23, "arm_inertia": 9.5e-5})


def test_deviations_stand_beside_the_constants():
    assert UNCERTAIN.rig == EXACT.rig == {"total_mass": 1.23, "arm_inertia": 9.5e-5}
    assert UNCERTAIN.rig_std == {"total_mass": 1e-3}
    assert EXACT.rig_std == {}
    assert pickle.loads(pickle.dumps(UNCERTAIN)) == UNCERTAIN != EXACT
    assert dataclasses.replace(UNCERTAIN, comment="again").rig_std == UNCERTAIN.rig_std
    assert UNCERTAIN["free_1"].cut(0, 20).initial_arm_angle_std == 0.02
    assert UNCERTAIN["free_1"].cut(5, 20).initial_arm_angle_std is None


def test_a_file_keeps_them(tmp_path):
    UNCERTAIN.save(tmp_path / "rig.h5")
    assert Recording.load(tmp_path / "rig.h5") == UNCERTAIN


def test_a_file_without_them_has_the_digest_that_it_always_had():
    assert digest(EXACT).split("\n") == [
        "c8ff9a52f23d37cd /",
        "3266170c24b3f05f /rig",
        "dca5e7e53e9faa38 /experiments/free_1",
        "f89846dd7a693f20 /experiments/free_1/outputs/cart_position",
    ]
    assert digest(UNCERTAIN).split("\n")[1:3] != digest(EXACT).split("\n")[1:3]


@pytest.mark.parametrize("reader", ["csv", "mat"])
def test_importers_take_them(tmp_path, reader):
    scipy_io = pytest.importorskip("scipy.io")
    options = {"channels": {"cart_position": "q"}, "kind": "free", "sample_time": 0.01, "name": "free_1"}
    options |= {"initial_arm_angle": 0.5, "initial_arm_angle_std": 0.02, "rig": RIG}
    path = tmp_path / f"log.{reader}"
    if reader == "csv":
        path.write_text("q\n" + "\n".join(map(repr, np.cos(T).tolist())))
        found = Recording.from_csv(path, **options)
    else:
        scipy_io.savemat(path, {"q": np.cos(T)})
        found = Recording.from_mat(path, **options)
    assert found == UNCERTAIN


def test_they_are_told_in_words():
    told = rtac.describe(UNCERTAIN)
    assert "total_mass = 1.23 +- 0.001 kg, arm_inertia = 9.5e-05 kg m^2" in told
    assert "arm starts at 0.5 +- 0.02 rad" in told
    assert (
        "\nwithout a deviation, so exact: arm_inertia; give arm_inertia_std beside arm_inertia where it is not\n"
        in told
    )
    sure = dataclasses.replace(UNCERTAIN, rig={**UNCERTAIN.rig, "arm_inertia_std": 1e-6})
    assert "so exact" not in rtac.describe(sure)


@pytest.mark.parametrize("value", [0.0, -1.0, np.inf, np.nan, "wide"])
def test_what_is_no_deviation_is_refused_in_one_sentence(value):
    for place, make in (
        (
            r"^/rig/total_mass_std: the standard deviation is ",
            lambda: Recording((released(),), {**RIG, "total_mass_std": value}),
        ),
        (r"^/experiments/free_1: initial_arm_angle_std \[rad\] is ", lambda: released(initial_arm_angle_std=value)),
    ):
        with pytest.raises(RecordingError, match=place) as caught:
            make()
        assert "\n" not in str(caught.value)


def test_a_deviation_of_nothing_is_refused():
    with pytest.raises(RecordingError, match="there is no constant torque_constant beside it"):
        Recording((released(),), {"torque_constant_std": 1e-3})
    with pytest.raises(RecordingError, match="has no initial_arm_angle beside it"):
        Experiment.of("x", kind="free", sample_time=0.01, cart_position=np.cos(T), initial_arm_angle_std=0.1)


def test_recordings_that_disagree_about_them_are_not_joined():
    other = Recording((dataclasses.replace(released(), name="b"),), {**RIG, "total_mass_std": 2e-3})
    with pytest.raises(RecordingError, match=r"/rig/total_mass_std: is 0\.001 in one recording and 0\.002 in another"):
        Recording.join(UNCERTAIN, other)
    alike = dataclasses.replace(other, rig_std={"total_mass": 1e-3})
    assert Recording.join(EXACT, alike).rig_std == {"total_mass": 1e-3}


def test_the_virtual_rig_writes_a_weighing_and_its_deviation():
    plans = standard_plans(seed=1, duration=1.0, free=1, forced=0, rest=0)
    stds = {"arm_inertia": 4e-7}
    exact = record(Rig(), plans, seed=5)
    weighed = [record(Rig(), plans, seed=seed, constants_std=stds) for seed in (5, 5, 6)]
    assert weighed[0] == weighed[1]
    assert weighed[0].rig["arm_inertia"] != weighed[2].rig["arm_inertia"]
    for one in weighed:
        assert one.rig_std == stds
        assert one.rig["total_mass"] == 1.23
        assert 0 < abs(one.rig["arm_inertia"] - 9.5e-5) < 4 * 4e-7
    assert weighed[0].experiments == exact.experiments
    with pytest.raises(ValueError, match="constants_std names spring_stiffness"):
        record(Rig(), plans, seed=5, constants_std={"spring_stiffness": 1.0})
