"""`rtac envelope`: what it writes, against the rig itself, and how it refuses."""

import json
import re

import numpy as np
import pytest
import scipy.io
from command_line import call, check_report, refused, reported
from operating_conditions import CONDITIONS, RIG, check_refusals, recorded, saved, smooth

from estimators.study.truth import FIELD_OF
from rtac_jax import RTAC


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return saved(tmp_path_factory.mktemp("recording"))


@pytest.fixture(scope="module")
def ran(file, tmp_path_factory):
    """The command once."""
    return reported("envelope", file, tmp_path_factory.mktemp("report"))


def test_the_report_is_whole(ran):
    assert "envelope" in check_report(*ran)
    assert (ran[1] / "envelope.mat").exists()


def test_the_fitted_model_is_held_against_the_envelope(ran):
    """Against equations (1) and (2) of the rig at small motions, without dry friction, in plain NumPy."""
    result, _, content = ran
    omega = np.array(content["frequency"])
    s = 1j * omega
    arm = RIG.arm_inertia * s**2 + 0.5 * (RIG.arm_viscous_positive + RIG.arm_viscous_negative) * s
    cart = RIG.total_mass * s**2 + RIG.cart_viscous * s + RIG.spring_stiffness
    push = RIG.eccentric_moment * s**2
    truth = -push * RIG.torque_constant / (cart * arm - push**2)
    distance = np.max(np.abs(truth / at(content["nominal"], omega) - 1) / np.abs(at(content["weight"], omega)))
    beside = content["fitted_model"]
    assert beside["distance"] == pytest.approx(distance, rel=0.3)  # the grid is coarse, and the model was fitted
    assert not beside["agrees"]  # the cart of this rig rubs
    assert beside["nominal_peak_over_fitted_db"] < 0
    assert f"{beside['distance']:.1f} times outside W" in result.stdout
    assert "play a multisine of" in result.stdout


def test_a_saved_model_is_held_against_the_envelope_in_place_of_the_closed_form(ran, file, tmp_path):
    truth = {name: getattr(RIG, field) for name, field in FIELD_OF.items()}
    RTAC.paper().with_values(truth).save(tmp_path / "truth.h5")
    result = call("envelope", file, "--model", tmp_path / "truth.h5", "--json", tmp_path / "envelope.json")
    content = json.loads((tmp_path / "envelope.json").read_text())
    assert content["fitted_model"]["distance"] == pytest.approx(ran[2]["fitted_model"]["distance"], rel=0.3)
    assert f"{content['fitted_model']['distance']:.1f} times outside W" in result.stdout
    assert "The closed form, linearised" not in result.stdout


def at(system, omega):
    return np.polyval(system["numerator"], 1j * omega) / np.polyval(system["denominator"], 1j * omega)


def factored(system, omega):
    s = 1j * omega[:, None]
    zeros, poles = (np.array([complex(*pair) for pair in system[name]]) for name in ("zeros", "poles"))
    return system["gain"] * np.prod(s - zeros, axis=1) / np.prod(s - poles, axis=1)


def test_the_weight_lies_above_every_condition(ran):
    content = ran[2]
    omega = np.array(content["frequency"])
    nominal, weight = at(content["nominal"], omega), at(content["weight"], omega)
    responses = np.array([one["response"] for one in content["conditions"]]) @ [1, 1j]
    gaps = np.abs(responses / nominal - 1)
    assert np.all(gaps <= np.abs(weight) * (1 + 1e-6))
    assert np.max(gaps, axis=0) == pytest.approx(content["profile"], rel=1e-6)
    assert content["method"] == "local"
    assert content["linear_models"] is None
    assert [one["distance"] for one in content["conditions"]] == pytest.approx(
        np.max(gaps / np.abs(weight), axis=1), rel=1e-6
    )
    assert all(one["inside"] for one in content["conditions"])
    for system in (content["nominal"], content["weight"]):
        assert all(real < 0 for real, _ in system["poles"])
        np.testing.assert_allclose(factored(system, omega), at(system, omega), rtol=1e-5)


def test_the_linearised_closed_form_is_beside_the_envelope(ran):
    """Against equations (1) and (2) at small motions; the rig has dry friction, so its responses are damped more."""
    text, _, content = ran
    omega = np.array(content["frequency"])
    s = 1j * omega
    cart = RIG.total_mass * s**2 + RIG.cart_viscous * s + RIG.spring_stiffness
    arm = RIG.arm_inertia * s**2 + 0.5 * (RIG.arm_viscous_positive + RIG.arm_viscous_negative) * s
    truth = -RIG.eccentric_moment * s**2 * RIG.torque_constant / (cart * arm - (RIG.eccentric_moment * s**2) ** 2)
    closed = np.array(content["closed_form"]["response"]) @ [1, 1j]
    assert np.max(np.abs(closed / truth - 1)) < 0.01
    nominal, weight = at(content["nominal"], omega), at(content["weight"], omega)
    needed = np.abs(closed / nominal - 1) / np.abs(weight)
    assert content["closed_form"]["needed"] == pytest.approx(needed.tolist(), rel=1e-5)
    assert content["closed_form"]["inside"] == bool(np.all(needed <= 1))
    words = content["closed_form"]["in_words"]
    assert f"lies {'inside' if np.all(needed <= 1) else 'outside'} W" in words
    assert f"{omega[np.argmax(needed)]:.3g} rad/s" in words
    assert words in text.stdout


def test_the_nominal_model_has_the_mode_of_the_rig(ran):
    poles = [complex(*pair) for pair in ran[2]["nominal"]["poles"]]
    natural = np.sqrt(RIG.spring_stiffness / RIG.total_mass)
    assert (
        min(abs(abs(p.imag) - natural) for p in poles) < 0.1 * natural
    )  # a compromise over conditions, no estimate of the mode


def test_the_held_out_condition_carries_the_coverage(ran):
    _, folder, content = ran
    assert [one["name"] for one in content["conditions"] if one["held_out"]] == ["condition_4"]
    assert content["coverage"]["method"] == "held out"
    assert content["coverage"]["probability"] == pytest.approx(0.05)  # 1 - 0.95 for a single one
    page = (folder / "report.html").read_text()
    assert "condition_1, condition_2, condition_3, condition_5, condition_6" in page
    shares = np.array(list(content["attribution"].values()))
    np.testing.assert_allclose(shares.sum(axis=0), 1.0)


def test_matlab_gets_the_same_envelope(ran):
    _, folder, content = ran
    held = scipy.io.loadmat(folder / "envelope.mat", simplify_cells=True)
    assert held["P0"]["den"] / held["P0"]["den"][0] == pytest.approx(
        np.array(content["nominal"]["denominator"]) / content["nominal"]["denominator"][0]
    )
    assert held["omega"] == pytest.approx(content["frequency"])


def test_orders_kind_and_band_are_obeyed(file, tmp_path):
    target = tmp_path / "x.json"
    options = ("--order", 2, "--weight-order", 3, "--kind", "additive", "--band", "1,5")
    assert call("envelope", file, *options, "--json", target).exit_code == 0
    content = json.loads(target.read_text())
    assert content["kind"] == "additive"
    assert (len(content["nominal"]["poles"]), len(content["weight"]["poles"])) == (2, 3)
    omega = np.array(content["frequency"])
    assert 2 * np.pi <= omega[0] < omega[-1] <= 10 * np.pi * (1 + 1e-9)
    responses = np.array([one["response"] for one in content["conditions"]]) @ [1, 1j]
    assert np.all(
        np.abs(responses - at(content["nominal"], omega)) <= np.abs(at(content["weight"], omega)) * (1 + 1e-6)
    )


@pytest.mark.slow
def test_the_largest_distance_of_the_weight_is_made_least_if_asked(tmp_path):
    """Of two conditions, of which none is held out: one that is raises the weight everywhere."""
    recorded().select(["condition_1", "condition_3", "rest_1"]).save(tmp_path / "two.h5")
    largest, mean = {}, {}
    for way in ("mean", "largest"):
        target = tmp_path / f"{way}.json"
        assert call("envelope", tmp_path / "two.h5", "--minimise", way, "--json", target).exit_code == 0
        content = json.loads(target.read_text())
        assert content["minimise"] == way
        above = 20 * np.log10(np.array(content["weight_magnitude"]) / content["profile"])
        assert content["largest_excess_db"] == pytest.approx(np.max(above), abs=1e-6)
        largest[way], mean[way] = np.max(above), content["excess_db"]
    assert largest["largest"] < largest["mean"]
    assert mean["mean"] < mean["largest"]


@pytest.mark.slow
def test_responses_may_be_those_of_linear_models(tmp_path):
    """Against equations (1) and (2) at small motions, in plain NumPy."""
    rig = RIG
    smooth().save(tmp_path / "smooth.h5")
    target = tmp_path / "x.json"
    result = call(
        "envelope", tmp_path / "smooth.h5", "--method", "prediction-error", "--order", 2, "--validation", "condition_4",
        "--out", tmp_path / "new", "--json", target,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    content = json.loads(target.read_text())
    assert content["method"] == "prediction-error"
    s = 1j * np.array(content["frequency"])
    arm = rig.arm_inertia * s**2 + 0.5 * (rig.arm_viscous_positive + rig.arm_viscous_negative) * s
    cart = rig.total_mass * s**2 + rig.cart_viscous * s + rig.spring_stiffness
    push = rig.eccentric_moment * s**2
    truth = -push * rig.torque_constant / (cart * arm - push**2)
    # Around the mode; below it the friction of the arm adds a real pole, which one mode has not.
    around = (s.imag > 9) & (s.imag < 20)
    for one in content["conditions"]:
        assert np.max(np.abs(np.array(one["response"]) @ [1, 1j] / truth - 1)[around]) < 0.25
    page = (tmp_path / "new" / "report.html").read_text()
    assert "Linear models of the conditions" in page
    assert len(content["linear_models"]) >= 2
    for said in content["linear_models"]:
        assert said in result.stdout
    assert re.search(r"conditions have one set of parameters|conditions differ", content["linear_models"][-1])


# -- refusals --------------------------------------------------------------------------------------------------------


def test_recordings_that_do_not_allow_it_are_refused(tmp_path):
    check_refusals("envelope", tmp_path)


@pytest.mark.parametrize("band", ["5", "5,1", "a,b", "0,3"])
def test_a_band_that_is_none_is_wrong_use(file, band):
    refused(call("envelope", file, "--band", band), 2, "--band")


def test_a_band_without_lines_does_not_allow_it(file):
    refused(call("envelope", file, "--band", "1,1.2"), 1, "lines in common")


def test_options_out_of_range_are_wrong_use(file):
    refused(call("envelope", file, "--validation", "fred"), 2, "fred", "condition_1")
    assert call("envelope", file, "--kind", "sideways").exit_code == 2
    assert call("envelope", file, "--order", 0).exit_code == 2


def test_all_held_out_but_one_does_not_allow_it(file):
    held = ",".join(f"condition_{n}" for n in range(2, CONDITIONS + 1))
    refused(call("envelope", file, "--validation", held), 1, "at least two")
