"""The JSON of a diagnosis and an improvement: one form, whatever the verdict."""

import dataclasses
import json

import numpy as np
import pytest
from made_up_results import (
    LEARNED,
    NOISE,
    OTHERS,
    diagnosis,
    improvement,
)

from estimators.core.fisher_information import information_of
from estimators.core.fit import Fit
from estimators.core.results import RESULTS
from estimators.linear.homogeneity_test import Equality
from estimators.linear.outlier import Outlier
from estimators.plots.improvement import finding
from estimators.reporting.diagnosis_summary import of_diagnosis
from estimators.reporting.html import write_json
from estimators.reporting.report import report_dict
from rtac_jax import RTAC

ACCEPTED = {"adequate": [], "missing": ["flexible_mode"], "ambiguous": ["flexible_mode", "cubic_spring"], "unknown": []}
RIVALS = {"flexible_mode": ["cubic_spring"], "cubic_spring": ["flexible_mode"]}


def fitted():
    """A fit in which each experiment has a friction of its own."""
    model = RTAC.paper().each_experiment("cart_coulomb.level").with_values({"cart_coulomb.level": np.array([0.1, 0.2])})
    known = information_of(np.zeros((1, 0)), (), np.zeros(0))
    return Fit(model, RESULTS.successful, known, NOISE, NOISE, {}, ("free_1", "forced_1[0:1024]"), {})


@pytest.mark.parametrize("command", ["diagnose", "improve"])
@pytest.mark.parametrize("verdict", ACCEPTED)
def test_the_json_has_one_form_whatever_the_verdict(verdict, command, tmp_path):
    steps = 2 if ACCEPTED[verdict] else 1
    loop = dataclasses.replace(improvement(steps, verdict), fits=(fitted(),) * steps)
    found = loop if command == "improve" else loop.diagnoses[0]
    write_json(tmp_path / "x.json", report_dict(found, fit=fitted(), train=loop.train, validation=loop.validation))
    content = json.loads((tmp_path / "x.json").read_text(), parse_constant=pytest.fail)
    assert list(content) == [
        "format", "version", "verdict", "mended", "effects", "candidates", "parameters", "error", "next_experiment", "seconds",
        "policy", "consequence", "learned_force", "likely_effect", "recommended", "varying", "left_out", "broken_off",
    ]  # fmt: skip
    assert content["verdict"] == verdict
    # The loop adds one of a group; a diagnosis names them all. Either says what it may be instead.
    assert [e["id"] for e in content["effects"]] == ACCEPTED[verdict][: 1 if command == "improve" else None]
    for effect in content["effects"]:
        assert set(effect) == {"id", "score", "p_value", "error_reduction", "confusable_with", "parameters"}
        assert effect["confusable_with"] == (RIVALS[effect["id"]] if verdict == "ambiguous" else [])
    assert {c["id"] for c in content["candidates"]} == {c.id for c in (*diagnosis(verdict).effects, *OTHERS)}
    assert [c["id"] for c in content["candidates"] if c["accepted"]] == [e["id"] for e in content["effects"]]
    for side in ("train", "validation"):
        before, after = (content["error"][side][moment] for moment in ("before", "after"))
        assert set(before) == {"cart_position", "arm_velocity"}
        for channel, numbers in before.items():
            assert set(numbers) == {"fit_percent", "rms", "rms_over_noise"}
            falls = after[channel]["rms"] < 0.5 * numbers["rms"]
            assert falls if steps > 1 else after == before


def test_the_json_marks_a_learned_force_and_gives_its_range():
    loop = dataclasses.replace(improvement(2, "unknown"), fits=(fitted(),) * 2, learned=LEARNED)
    found = report_dict(loop)
    assert (found["verdict"], found["effects"]) == ("unknown", [])
    told = found["learned_force"]
    assert told["physical"] is False
    assert told["between"] == [-0.012, 0.014]
    assert (told["variable"], told["variable_unit"], told["port"], told["unit"]) == ("cart_position", "m", "cart", "N")
    assert len(told["at"]) == len(told["force"]) == len(told["std"])
    before, after = (found["error"]["validation"][moment]["cart_position"] for moment in ("before", "after"))
    assert after["rms"] < before["rms"]


def test_the_json_gives_what_each_experiment_has_for_itself():
    found = report_dict(diagnosis(), fit=fitted())["parameters"]
    assert "cart_coulomb.level" not in found
    assert found["cart_coulomb.level[free_1]"] == {"value": 0.1, "std": None, "unit": "N"}
    assert found["cart_coulomb.level[forced_1[0:1024]]"]["value"] == 0.2
    assert found["spring_stiffness"]["unit"] == "N/m"


def differing(over_noise: float, left: float) -> Equality:
    """Four experiments; the third differs from the others, which a fit leaves at so many times the noise, and it."""
    return Equality(
        names=("torque_constant",), units=("N m/A",), conditions=("a", "b", "c", "d"),
        values=np.array([[1.0], [1.0], [2.0], [1.0]]), std=np.full((4, 1), 0.1), common=np.ones(1), common_std=np.full(1, 0.1),
        chi_square=100.0, freedom=3, p_value=1e-9, p_values=np.array([1e-9]), trends=((),), covariates={}, left_out=(), level=0.01,
        varying=("torque_constant",), explained=1.0, suffices=True,
        outlying=Outlier("c", 1.0, 2, None, over_noise, left, "arm_angle"),
    )  # fmt: skip


@pytest.mark.parametrize(("over_noise", "left", "name"), [(1.02, 20.0, "c"), (1.6, 20.0, None), (1.02, 1.2, None)])
def test_the_experiment_that_differs_is_told_if_all_others_are_followed(over_noise, left, name):
    loop = dataclasses.replace(improvement(1, "adequate"), constancy=differing(over_noise, left))
    told = report_dict(loop, fit=fitted(), train=loop.train, validation=loop.validation)["varying"]
    assert told["outlying"] == name
    assert told["parameters"] == {}, "no experiment was followed by itself"
    bullets = of_diagnosis(loop, loop.train, loop.validation, file="rig.h5")
    assert ("c alone differs from all other experiments" in str(bullets)) == (name is not None)
    assert ("Look at c: its sample time" in str(bullets)) == (name is not None)
    assert ("All experiments but c are followed to" in loop.headline) == (name is not None)


def test_where_one_parameter_differs_between_experiments_it_is_one_set_for_all_that_fails():
    alike = dataclasses.replace(differing(1.0, 1.0), outlying=None)
    loop = dataclasses.replace(
        improvement(1, "unknown"), added=(), constancy=dataclasses.replace(alike, over_noise={"arm_angle": 1.1})
    )
    assert "One set of parameters for all fails, and no effect" in loop.headline
    bullets = of_diagnosis(loop, loop.train, loop.validation, file="rig.h5")
    assert bullets.found.endswith("; torque_constant differs between experiments.")
    assert bullets.next.startswith("Give each experiment a value of its own (model.each_experiment('torque_constant'))")
    assert finding(loop).startswith(
        "Experiments differ in torque_constant: with one value for all the held-out error of"
    )
    far = dataclasses.replace(loop, constancy=dataclasses.replace(alike, over_noise={"arm_angle": 1.4}))
    assert finding(far).startswith("No effect could be added: the held-out error of")
    assert "The model fails, and no effect" in far.headline


def test_where_several_parameters_differ_they_are_told_together_if_one_fit_confirmed_it():
    names = ("arm_viscous.positive", "arm_viscous.negative")
    one = differing(1.0, 1.0)
    several = dataclasses.replace(
        one, names=names, units=("N m s/rad",) * 2, values=np.repeat(one.values, 2, axis=1), std=np.repeat(one.std, 2, axis=1),
        common=np.ones(2), common_std=np.full(2, 0.1), p_values=np.full(2, 1e-9), trends=((), ()), varying=names, outlying=None,
        over_noise={"arm_angle": 1.1}, confirmed=True,
    )  # fmt: skip
    loop = dataclasses.replace(improvement(1, "unknown"), added=(), constancy=several)
    bullets = of_diagnosis(loop, loop.train, loop.validation, file="rig.h5")
    assert bullets.found.endswith("; arm_viscous.positive and arm_viscous.negative differ between experiments.")
    assert "model.each_experiment('arm_viscous.positive', 'arm_viscous.negative')" in bullets.next
    assert finding(loop).startswith("Experiments differ in arm_viscous.positive and arm_viscous.negative: with one set")
    unconfirmed = dataclasses.replace(loop, constancy=dataclasses.replace(several, confirmed=False))
    assert (
        "differ between experiments" not in of_diagnosis(unconfirmed, loop.train, loop.validation, file="rig.h5").found
    )
