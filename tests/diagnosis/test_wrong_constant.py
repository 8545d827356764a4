"""A constant that is wrong: named beside what looks like it, and no sign of anything where its deviation is stated."""

import dataclasses
from functools import reduce

import made_up_results
import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from estimators.diagnosis.candidate_set import offered
from estimators.diagnosis.evidence import FittedModel
from estimators.diagnosis.explanation import words
from estimators.diagnosis.step import Step
from estimators.diagnosis.wrong_constant import doubt, stands_for, without_constants
from rtac_jax import virtual_rig
from rtac_jax.effects import CATALOGUE, Effect
from rtac_jax.effects.wrong_constant import WRONG_CONSTANTS, WrongArmInertia, WrongTotalMass

RIG = virtual_rig.Rig().drawn(4)
OFF = 0.05
FEW: list[type[Effect]] = [CATALOGUE[n] for n in ("lvdt_gain", "cubic_spring")]
ALIKE = {"lvdt_gain", "wrong_arm_inertia"}


@pytest.fixture(scope="module")
def recording() -> rtac.Recording:
    plans = virtual_rig.standard_plans(seed=11, sample_time=0.005, duration=4.0, free=1, forced=3, rest=1)
    exact = virtual_rig.record(RIG, plans, seed=3)
    return dataclasses.replace(exact, rig={**exact.rig, "arm_inertia": (1 + OFF) * RIG.arm_inertia})


def diagnosed(recording: rtac.Recording, candidates: list[type[Effect]] | None) -> est.Diagnosis:
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    return est.diagnose(fit, recording, candidates=candidates, progress=False)


def test_wrong_constants_are_offered_where_two_are_exact(recording: rtac.Recording) -> None:
    model = rtac.RTAC.from_rig(recording)
    ids = {c.id for c in offered(model, None)}
    assert ids - set(CATALOGUE) == {"wrong_arm_inertia"}  # which stands for the mass too: their ratio is all that shows
    third = {c.id for c in offered(model.fix("spring_stiffness"), None)}
    assert third - set(CATALOGUE) == {"wrong_arm_inertia", "wrong_total_mass", "wrong_spring_stiffness"}
    assert {c.id for c in offered(model, FEW)} == {c.id for c in FEW}
    for freed in ("arm_inertia", "total_mass"):  # of one constant alone nothing can be wrong: it is the scale
        assert not {c.id for c in offered(model.release(freed), None)} - set(CATALOGUE)
    sure = dataclasses.replace(recording, rig_std={"arm_inertia": 1e-7})
    assert not {c.id for c in offered(rtac.RTAC.from_rig(sure), None)} - set(CATALOGUE)


def test_each_changes_its_constant_and_nothing_else() -> None:
    """Against a model that has the other value, in a motion of cart and arm."""
    time = 0.004 * np.arange(120)
    push = rtac.Experiment.of(
        "a", kind="forced", sample_time=0.004, current=0.3 * np.sin(11 * time), cart_position=time
    )
    start = {"a": (0.01, 0.02, 0.7, 4.0)}
    paper = rtac.RTAC.paper()
    absent = reduce(rtac.RTAC.__add__, [cls.absent() for cls in WRONG_CONSTANTS.values()], paper)
    for name, cls in WRONG_CONSTANTS.items():
        by = 0.03
        amount = by * float(paper[name]) if cls is WrongTotalMass else by
        wrong = absent.with_values({f"{cls.id}.{cls.amplitudes()[0]}": amount})
        truth = paper.with_values({name: (1 + by) * float(paper[name])})
        one, other = (rtac.simulate(model, [push], start=start, substeps=2)["a"] for model in (wrong, truth))
        for channel in ("cart_position", "arm_velocity"):
            np.testing.assert_allclose(getattr(one, channel), getattr(other, channel), rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_wrong_constant_is_not_told_from_a_sensors_gain(recording: rtac.Recording) -> None:
    found = diagnosed(recording, [*FEW, WrongArmInertia])
    assert found.verdict == "ambiguous", found
    assert {c.id for c in found.effects} == ALIKE, found
    inertia = next(c for c in found.effects if c.id == "wrong_arm_inertia").parameters["error"]
    assert inertia.value == pytest.approx(1 / (1 + OFF) - 1, abs=4 * inertia.std)
    assert inertia.std < 0.01
    assert "Wrong constant: total_mass or arm_inertia" in found.explanation
    assert "arm_inertia_std" in found.explanation


@pytest.mark.slow
def test_no_experiment_is_planned_for_what_no_motion_tells(recording: rtac.Recording) -> None:
    """Two percent of the inertia are a percent of the sensor's gain, but for what one straight line misses of it."""
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    found = est.diagnose(fit, recording, candidates=[*FEW, WrongArmInertia], progress=False)
    planned = est.next_experiment(fit, recording, found, candidates=[*FEW, WrongArmInertia], progress=False)
    assert set(planned.effects) == ALIKE
    assert max(planned.already.values()) < 1.0
    assert "measured by itself" in planned.hopeless
    assert str(planned) == planned.hopeless


@pytest.mark.slow
def test_beside_a_lag_a_sensors_gain_is_not_told_from_a_wrong_constant_either() -> None:
    """That the constant's error could not be seen before the lag was in the model says nothing of what it looks like."""
    plans = virtual_rig.standard_plans(seed=11, sample_time=0.005, duration=4.0, free=1, forced=3, rest=1)
    lagging = virtual_rig.record(dataclasses.replace(RIG, current_lag=0.005), plans, seed=3)
    off = dataclasses.replace(lagging, rig={**lagging.rig, "arm_inertia": (1 + OFF) * RIG.arm_inertia})
    found = diagnosed(off, [*FEW, CATALOGUE["current_lag"], WrongArmInertia])
    assert found.verdict == "ambiguous", found
    assert {c.id for c in found.effects} == {"current_lag", *ALIKE}, found
    assert [c.id for c in found.effects if not c.confusable_with] == ["current_lag"]


@pytest.mark.slow
def test_with_its_deviation_nothing_is_missing(recording: rtac.Recording) -> None:
    stated = dataclasses.replace(recording, rig_std={"arm_inertia": OFF * RIG.arm_inertia})
    found = diagnosed(stated, FEW)
    assert found.verdict == "adequate", found


def test_doubt_names_the_constants() -> None:
    model = rtac.RTAC.paper().fix("total_mass", "arm_inertia", "spring_stiffness")
    assert doubt(["cubic_spring"], model) == ""
    assert "Wrong constant: arm_inertia is taken as exact" in doubt(["lvdt_gain", "wrong_arm_inertia"], model)


@pytest.mark.slow
@pytest.mark.parametrize("stated", [False, True], ids=["exact", "uncertain"])
def test_constants_of_a_bifilar_test(stated: bool) -> None:
    """Mass off by 0.01 %, inertia by 0.43 %, and nothing hidden, on a recording that is long enough to show it."""
    plans = virtual_rig.standard_plans(seed=6, sample_time=0.002, duration=10.0, free=6, forced=12, rest=1)
    exact = virtual_rig.record(virtual_rig.Rig().drawn(7), plans, seed=8)
    off = {"total_mass": 1.0001, "arm_inertia": 1.0043}
    rig = {name: value * off[name] for name, value in exact.rig.items()}
    stds = {name: (off[name] - 1) * value for name, value in exact.rig.items()} if stated else {}
    found = diagnosed(dataclasses.replace(exact, rig=rig, rig_std=stds), None)
    if stated:
        assert found.verdict == "adequate", found
    else:
        assert found.verdict in ("ambiguous", "adequate"), found
        assert {c.id for c in found.effects} in (ALIKE, set()), found


def test_the_headline_says_what_a_wrong_inertia_stands_for() -> None:
    """With mass and inertia alone exact their ratio is all that shows; the group's name holds one of them only."""
    model = rtac.RTAC.paper().release(
        "total_mass", "arm_inertia", "spring_stiffness", "torque_constant", "eccentric_moment"
    )
    model = model.fix("total_mass", "arm_inertia")
    said = stands_for(["lvdt_gain", "wrong_arm_inertia"], model)
    assert said.startswith(" wrong_arm_inertia stands for an error of total_mass or of arm_inertia")
    assert stands_for(["lvdt_gain"], model) == ""
    assert stands_for(["wrong_arm_inertia"], model.fix("spring_stiffness")) == "", (
        "there each has a candidate of its own"
    )
    added = (made_up_results.candidate("wrong_arm_inertia", 900.0, confusable_with=("lvdt_gain",)),)
    found = made_up_results.improvement(2)
    base = dataclasses.replace(found.fits[0], model=model)
    assert said in dataclasses.replace(found, added=added, fits=(base, *found.fits[1:])).headline


@pytest.mark.parametrize(("rival", "decides"), [("cubic_spring", True), ("wrong_arm_inertia", False)])
def test_no_experiment_is_promised_to_tell_a_wrong_constant(rival: str, decides: bool) -> None:
    assert without_constants(["lvdt_gain", rival]) is decides
    assert without_constants(["lvdt_gain", rival, "arm_coulomb"]), "two of them are no constants"
    blank = FittedModel(1, ("lvdt_gain",), 1, 0.0)
    step = Step("lvdt_gain", (rival,), 500.0, 500.0, 250.0, blank, ())
    several = [made_up_results.candidate(name, 500.0) for name in ("lvdt_gain", rival)]
    text = words("ambiguous", several, several, [step], (), (), 0.99, [], [], [], [])
    assert "cannot tell lvdt_gain or" in text
    assert ("est.next_experiment" in text) is decides
