"""`rtac next-experiment` and `rtac design`: what a rig is asked to play, within its limits."""

import dataclasses
import json

import numpy as np
import pytest
from command_line import call, refused
from made_up_results import diagnosis
from small_experiments import forced, free, rest

import estimators as est
import rtac_jax as rtac
from estimators.cli.job import Job
from estimators.cli.planned import plan_next
from rtac_jax.measurement import Plan, Recording

PAIR = ("flexible_mode", "cubic_spring")


@pytest.fixture
def file(tmp_path):
    Recording((free(), forced(), rest()), {"total_mass": 1.23, "arm_inertia": 9.5e-5}).save(tmp_path / "rig.h5")
    return tmp_path / "rig.h5"


def planned():
    time = 0.01 * np.arange(200)
    plan = Plan("square 1 Hz at 0 degrees", "forced", 2.0, 0.01, np.sign(np.sin(6.3 * time + 0.1)))
    played = rtac.Experiment.of(
        plan.name, kind="forced", sample_time=0.01, current=plan.current, cart_position=0.001 * np.sin(6.3 * time)
    )
    best = est.PlannedExperiment(plan, {PAIR: 321.0}, 0.004, 0.02, 12.0, 0.3)
    return est.NextExperiment(PAIR, {PAIR: 2.5}, (best,), ("decay: too far",), Recording((played,)))


@pytest.fixture
def asked(monkeypatch):
    """What the estimators were asked for; they have tests of their own."""
    found = {"diagnosed": 0}

    def diagnose(*_, **options):
        found.update(diagnosed=found["diagnosed"] + 1, thorough=options["thorough"])
        return diagnosis("ambiguous")

    def plan(fit, recording, known, **options):
        found.update(options, fit=fit, verdict=known.verdict, names=recording.names)
        return planned()

    monkeypatch.setattr(est, "output_error", lambda *_, **__: "a fit")
    monkeypatch.setattr(est, "diagnose", diagnose)
    monkeypatch.setattr(est, "next_experiment", plan)
    return found


def test_the_next_experiment_is_planned_and_can_be_played(file, asked, tmp_path):
    result = call(
        "next-experiment", file, "--quick", "--travel", "12", "--torque-limit", "0.05", "--play", tmp_path / "next.csv",
        "--json", tmp_path / "next.json", "--out", tmp_path / "out", "--between", "flexible_mode, cubic_spring",
        "--current-limit", "0.4",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert (asked["diagnosed"], asked["thorough"], asked["fit"]) == (1, False, "a fit")
    assert (asked["travel"], asked["torque_limit"]) == (pytest.approx(0.012), 0.05)
    assert asked["current_limit"] == 0.4
    assert "current 0.4 A (--current-limit)" in result.stdout
    assert asked["between"] == list(PAIR)
    assert "ambiguous (flexible_mode, cubic_spring)" in result.stdout
    assert "from 2.5 to 321" in result.stdout
    back = Recording.from_csv(
        tmp_path / "next.csv", channels={"current": "current [A]", "cart_position": "cart_position [m]"}, time="time [s]",
        kind="forced",
    )  # fmt: skip
    assert np.array_equal(back["next"].inputs["current"].values, planned().current)
    content = json.loads((tmp_path / "next.json").read_text(), parse_constant=pytest.fail)
    assert content["verdict"] == "ambiguous"
    assert content["next_experiment"]["name"] == "square 1 Hz at 0 degrees"
    page = (tmp_path / "out" / "report.html").read_text()
    assert "321" in page
    assert "<b>Found.</b> square 1 Hz at 0 degrees, 2 s" in page
    assert "MEASURED.csv" in page


def test_a_diagnosis_that_was_kept_need_not_be_made_again(file, asked, tmp_path):
    diagnosis("ambiguous").save(tmp_path / "found.h5")
    result = call("next-experiment", file, "--diagnosis", tmp_path / "found.h5")
    assert result.exit_code == 0, result.output
    assert asked["diagnosed"] == 0
    assert asked["verdict"] == "ambiguous"
    rtac.RTAC.paper().save(tmp_path / "model.h5")
    refused(
        call("next-experiment", file, "--diagnosis", tmp_path / "model.h5"), 2, "holds a RTAC", "rtac diagnose --save"
    )
    refused(call("next-experiment", file, "--travel", "-1"), 2, "--travel is -1")
    refused(call("next-experiment", file, "--current-limit", "0"), 2, "--current-limit is 0")
    refused(call("next-experiment", file, "--play", "x.mat"), 2, "--play", ".csv")


def test_a_design_keeps_to_the_limits_and_to_the_model_that_was_named(tmp_path):
    model = rtac.RTAC.paper().with_values({"torque_constant": 0.16})
    model.save(tmp_path / "mine.h5")
    out = tmp_path / "play.h5"
    result = call(
        "design", out, "--model", tmp_path / "mine.h5", "--angles", "0,0.4", "--amplitudes", "1,0.5", "--duration", "3",
        "--band", "1,4", "--rms", "3", "--torque-limit", "0.05", "--travel", "5", "--csv",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    designed = Recording.load(out)
    assert designed.names == ("condition_1", "condition_2")
    assert [e.initial_arm_angle for e in designed] == [0.0, 0.4]
    currents = [e.inputs["current"].values for e in designed]
    torque = 0.16 * max(np.max(np.abs(c)) for c in currents)
    travel = max(np.max(np.abs(e.outputs["cart_position"].values)) for e in designed)
    assert torque <= 0.05 * (1 + 1e-12)
    assert travel <= 0.005
    assert max(torque / 0.05, travel / 0.005) > 0.7  # 3 A are far too much, and not lowered further than it takes
    spectrum = np.abs(np.fft.rfft(currents[0]))
    frequency = np.fft.rfftfreq(len(currents[0]), 0.01)
    inside = (frequency > 0.6) & (frequency < 4.4)
    assert np.sum(spectrum[inside] ** 2) > 0.9 * np.sum(spectrum**2)
    assert (tmp_path / "play_condition_2.csv").is_file()
    assert "Model: that of mine.h5." in result.stdout


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--band", "4,1"), ("--band is '4,1'", "two frequencies")),
        (("--band", "1,80"), ("below half of the sampling rate, 50 Hz",)),
        (("--angles", "zero"), ("--angles is 'zero'", "numbers between commas")),
        (("--rms", "0"), ("--rms is 0",)),
        (("--model", "none.h5"), ("--model: none.h5: there is no such file",)),
    ],
)
def test_a_design_that_cannot_be_is_one_sentence(tmp_path, options, words):
    refused(call("design", tmp_path / "play.h5", *options), 2, *words)
    assert not (tmp_path / "play.h5").exists()
    refused(call("design", tmp_path / "play.csv"), 2, "let the name end in .h5")


def test_limits_are_named_and_what_is_open_no_more_is_said(file, asked, monkeypatch):
    def settled(*_, **__):
        return dataclasses.replace(planned(), already={PAIR: 20.0})

    told = "By these models the recording tells these apart already"
    result = call("next-experiment", file, "--travel", "12")
    assert (
        "Within these limits of the rig: travel 12 mm (--travel), torque 0.1 N m (--torque-limit), arm 55 rad/s"
        in result.stdout
    )
    assert told not in result.stdout
    monkeypatch.setattr(est, "next_experiment", settled)
    assert told in call("next-experiment", file).stdout


@pytest.mark.parametrize(("rival", "planned_for"), [("cubic_spring", True), ("wrong_arm_inertia", False)])
def test_nothing_is_planned_that_would_tell_a_wrong_constant(monkeypatch, rival, planned_for):
    effects = tuple(
        dataclasses.replace(c, id=i, confusable_with=(other,))
        for c, i, other in zip(diagnosis("ambiguous").effects, ("lvdt_gain", rival), (rival, "lvdt_gain"), strict=False)
    )
    asked = []
    monkeypatch.setattr(est, "next_experiment", lambda *_, **__: asked.append(1) or planned())
    work = Job("rig.h5", Recording((free(), forced(), rest())), None, None, None, 0.0)
    found = plan_next(work, "a fit", dataclasses.replace(diagnosis("ambiguous"), effects=effects), None)
    assert (found is not None) is planned_for
    assert bool(asked) is planned_for
