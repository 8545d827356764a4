"""The command line: what it writes and what it says."""

import datetime
import functools
import hashlib
import html
import json
import re
import shlex

import pytest
from command_line import COMMANDS, call, check_report, refused, reported

import estimators
import estimators as est
import estimators.diagnosis.candidate_set
from estimators import Improvement
from estimators.output_error.fit import output_error
from rtac_jax.effects import CATALOGUE

FIGURES = {
    "fit": {"agreement", "comparison", "residuals", "correlations", "recording"},
    "compare": {"comparison", "residuals"},
    "diagnose": {"diagnosis", "where", "confusion", "bands", "comparison", "residuals"},
    "improve": {
        "improvement", "diagnosis_1", "where", "confusion", "bands", "comparison", "residuals_before", "residuals_after",
        "recording",
    },
}  # fmt: skip
TRIED = ("flexible_mode", "cubic_spring")
SEVERAL = "compare, several models"
TOO_LONG = "fit, of a recording that is too long to compare"


@pytest.fixture(scope="module")
def ran(file, tmp_path_factory):
    """Every command once, with a short catalogue: exit status, output, folder and JSON.

    The fits of the first command serve the others, and what `improve` would find is put together from what `diagnose`
    found: the loop has tests of its own, and this keeps the time to that of one diagnosis.
    """
    found, kept = {}, {}

    def once(name):
        original = getattr(estimators, name)

        def remembered(subject, *arguments, **options):
            key = (name, subject.ids if hasattr(subject, "ids") else name)
            if key not in kept:
                kept[key] = original(subject, *arguments, **options)
            return kept[key]

        return remembered

    def loop(model, recording, *, validation, candidates, thorough, learned_force, within):
        train, held_out = recording.split(validation)
        fits = tuple(fit for (name, _), fit in kept.items() if name == "output_error")
        (diagnosis,) = (record for (name, _), record in kept.items() if name == "diagnose")
        sides = [estimators.compare(fits, side, labels=["base", "+ flexible_mode"]) for side in (train, held_out)]
        return Improvement(
            fits, (diagnosis,), (0,), diagnosis.effects, "missing", *sides, (), False, (), "Stopped.", 1.0
        )

    saved = tmp_path_factory.mktemp("saved")
    found["saved"] = saved
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(estimators.diagnosis.candidate_set, "CATALOGUE", {name: CATALOGUE[name] for name in TRIED})
        patch.setattr(estimators, "output_error", once("output_error"))
        patch.setattr(estimators, "diagnose", once("diagnose"))
        patch.setattr(estimators, "improve", loop)
        patch.setattr(estimators, "agreement", functools.partial(estimators.agreement, draws=40))
        for command in COMMANDS:
            options = ("--save", saved / "fit.h5") if command == "fit" else ()
            found[command] = reported(command, file, tmp_path_factory.mktemp(command), *options)

        for (name, _), fit in kept.items():
            if name == "output_error":
                fit.save(saved / f"{'mended' if 'flexible_mode' in fit.model else 'base'}.h5")
        base = ("--model", saved / "base.h5")
        for command, options in (("diagnose", base), ("improve", (*base, "--quick"))):
            kept_in = saved / f"{command}.h5"
            found[f"{command} --model"] = call(command, file, *options, "--save", kept_in), kept_in, kept
        several = (*base, "--model", saved / "mended.h5", "--json", saved / "several.json", "--out", saved / "several")
        found[SEVERAL] = (
            call("compare", file, *several),
            saved / "several",
            json.loads((saved / "several.json").read_text()),
        )

        with pytest.MonkeyPatch.context() as limit:
            limit.setattr(estimators.cli.fit, "_TOO_LONG", 1)
            target = tmp_path_factory.mktemp("long") / "result.json"
            found[TOO_LONG] = call("fit", file, "--json", target), None, json.loads(target.read_text())

    return found


def check_parameters(parameters):
    for name, found in parameters.items():
        assert isinstance(name, str)
        assert set(found) == {"value", "std", "unit"}
        assert isinstance(found["value"], float)
        assert isinstance(found["std"], float)
        assert isinstance(found["unit"], str)


def check_errors(error):
    assert set(error) == {"train", "validation"}
    for side in error.values():
        assert set(side) == {"before", "after"}
        for moment in side.values():
            assert set(moment) == {"cart_position", "arm_velocity"}
            for numbers in moment.values():
                assert set(numbers) == {"fit_percent", "rms", "rms_over_noise"}
                assert all(isinstance(number, float) for number in numbers.values())


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_writes_what_it_promises(ran, command):
    result, _, content = ran[command]
    assert check_report(*ran[command]) == FIGURES[command]
    check_parameters(content["parameters"])
    if command == "fit":
        check_parameters(content["prediction_error"]["parameters"])
        assert content["prediction_error"]["force_noise"] > 0
        assert [p["between"] for p in content["agreement"]["pairs"]] == [
            ["closed form", "output error"], ["closed form", "prediction error"], ["output error", "prediction error"],
        ]  # fmt: skip
        assert "prediction error" in result.stdout
    check_errors(content["error"])
    assert content["parameters"]["total_mass"]["unit"] == "kg"


@pytest.mark.slow
def test_what_cannot_be_fitted_by_simulation_is_held_and_the_reader_told(file, tmp_path, monkeypatch):
    def refusing(model, *arguments, **options):
        if "flexible_mode.frequency" in model.free:
            raise estimators.NotIdentifiableError("The data leave it free.")
        return output_error(model, *arguments, **options)

    target = tmp_path / "result.json"
    monkeypatch.setattr(estimators.diagnosis.candidate_set, "CATALOGUE", {name: CATALOGUE[name] for name in TRIED})
    monkeypatch.setattr(estimators, "output_error", refusing)
    result = call("diagnose", file, "--json", target)
    content = json.loads(target.read_text())
    said = " ".join(result.stdout.split())
    assert "with flexible_mode could not be fitted by simulation: The data leave it free." in said
    assert "The errors after are those with flexible_mode, held at the estimate of the diagnosis." in said
    (effect,) = content["effects"]
    for name, told in effect["parameters"].items():
        assert content["parameters"][f"flexible_mode.{name}"] == told
    assert effect["parameters"]["frequency"]["std"] > 0
    before, after = (content["error"]["validation"][moment]["cart_position"]["rms"] for moment in ("before", "after"))
    assert after < 0.5 * before


@pytest.mark.parametrize("command", COMMANDS)
def test_the_report_needs_nothing_else(ran, command):
    page = (ran[command][1] / "report.html").read_text()
    assert "http://" not in page
    assert "https://" not in page
    assert not re.search(r"<script[^>]*src", page)  # nothing is loaded: the viewer of signals stands in the page
    assert page.count('class="viewer"') == 1
    assert all(source.startswith("data:image/png;base64,") for source in re.findall(r'src="([^"]*)', page))
    assert page.count("<img") == len(FIGURES[command])
    assert "rig &amp; &lt;co&gt;.h5" in page
    assert "<co>" not in page


@pytest.mark.parametrize("command", ["diagnose", "improve"])
def test_the_json_has_the_form_that_was_agreed(ran, command):
    content = ran[command][2]
    assert set(content) == {
        "format", "version", "verdict", "mended", "effects", "candidates", "parameters", "error", "next_experiment",
        "seconds", "policy", "consequence", "learned_force", "likely_effect", "recommended", "varying", "left_out",
        "broken_off",
    }  # fmt: skip
    assert content["verdict"] == "missing"
    assert content["next_experiment"] is None
    (effect,) = content["effects"]
    assert set(effect) == {"id", "score", "p_value", "error_reduction", "confusable_with", "parameters"}
    assert effect["id"] == "flexible_mode"
    assert effect["confusable_with"] == []
    check_parameters(effect["parameters"])
    assert effect["parameters"]["mass"]["value"] == pytest.approx(0.12, rel=0.05)
    assert {c["id"] for c in content["candidates"]} == {*TRIED, "wrong_arm_inertia"}  # mass and inertia count as exact
    for c in content["candidates"]:
        assert {"id", "p_value", "detection_limit", "testable"} <= set(c)
        assert isinstance(c["testable"], bool)
    held_out = content["error"]["validation"]
    before, after = (held_out[moment]["cart_position"]["rms_over_noise"] for moment in ("before", "after"))
    assert before > 5
    assert after < 1.5
    assert content["parameters"]["flexible_mode.frequency"]["value"] == pytest.approx(37.4, rel=0.01)


def test_fit_sets_both_estimates_side_by_side(ran):
    result, _, content = ran["fit"]
    assert "weak form" in result.stdout
    assert "output error" in result.stdout
    assert content["closed_form"]["torque_constant"]["unit"] == "N m/A"
    for pair in content["agreement"]["pairs"]:
        assert 0 <= pair["p_value"] <= 1
        assert {"spring_stiffness", "torque_constant"} <= set(pair["parameters"]) <= set(content["parameters"])
    assert content["agreement"]["verdict"]
    assert content["std"]["plain"]["torque_constant"] == pytest.approx(
        content["parameters"]["torque_constant"]["std"], rel=0.5
    )
    assert set(content["std"]) == {"plain", "sandwich", "clustered"}


def test_fit_recommends_one_estimate_and_shows_all_deviations_in_its_report(ran):
    result, folder, content = ran["fit"]
    # The rig has a flexible mode that the model lacks.
    advice = content["recommended"]
    assert not advice["sound"]
    assert advice["estimator"] == "prediction error"  # as the simulation is left at more than ten times the noise
    assert "output error does not follow the rig, being left at" in result.stdout
    for name in content["correlations"]["names"]:
        kinds = [content["std"][kind][name] for kind in ("sandwich", "clustered") if content["std"][kind][name]]
        assert advice["parameters"][name]["std"] >= max(kinds)
    assert (
        "Recommended: prediction error, with the standard deviation for a coloured residual or independent"
        in result.stdout
    )
    kept = est.load(ran["saved"] / "fit.h5")
    assert isinstance(kept, est.PredictorFit), "what is recommended is kept"
    assert {n: p.value for n, p in kept.parameters.items()} == pytest.approx(
        {n: p["value"] for n, p in advice["parameters"].items()}
    )
    assert content["criteria"]["bic"] > content["criteria"]["aic"]
    assert f"AIC {content['criteria']['aic']:.1f}" in result.stdout
    page = (folder / "report.html").read_text()
    heads = ("weak form std", "output error std, coloured residual", "output error std, independent experiments")
    assert all(f"{head}</th>" in page for head in heads)


@pytest.mark.parametrize("command", COMMANDS)
def test_a_report_says_first_what_was_found_how_sure_and_what_next_and_where_it_comes_from(ran, file, command):
    page = (ran[command][1] / "report.html").read_text()
    summary = page[page.index('class="summary"') : page.index("</section>")]
    places = [summary.index(f"<b>{head}.</b>") for head in ("Found", "How sure", "Next")]
    assert places == sorted(places)
    assert places[0] < min(summary.index(block) for block in ("<p>", "<table") if block in summary)
    assert summary.count("<li>") == 3
    assert hashlib.sha256(file.read_bytes()).hexdigest() in page
    assert datetime.date.today().isoformat() in page
    assert '<td data-head="setting">command</td>' in page
    if command in ("fit", "compare"):
        assert f"rtac diagnose {html.escape(shlex.quote(file.name))}" in summary
    elif command == "diagnose":
        assert "Missing: flexible_mode (" in summary
        assert "rtac improve" in summary


def test_compare_gives_correlations_at_both_signs_of_lag(ran):
    row = ran["compare"][2]["experiments"][0]["correlations"]
    assert row["lags"] == list(range(-25, 26))
    assert len(row["with_input"]) == 51
    assert len(row["autocorrelation"]) == 26
    assert row["autocorrelation"][0] == 1.0
    assert row["autocorrelation_band"] > 0


@pytest.mark.slow
def test_compare_predicts_ahead(ran, file, tmp_path, monkeypatch):
    target = tmp_path / "x.json"
    monkeypatch.setattr(estimators, "output_error", functools.partial(output_error, from_model=True))
    result = call("compare", file, "--ahead", 1, "--json", target)
    assert result.exit_code == 0, result.output
    near = json.loads(target.read_text())["error"]["validation"]["before"]["cart_position"]["rms"]
    assert near < 0.5 * ran["compare"][2]["error"]["validation"]["before"]["cart_position"]["rms"]


def test_of_a_recording_that_is_too_long_the_fit_is_shown_without_what_would_take_long(ran):
    result, _, content = ran[TOO_LONG]
    assert result.exit_code == 0, result.output
    said = " ".join(result.stdout.split())
    assert "No prediction error and no comparison of the estimates, which of " in said
    assert "(Experiment.cut)" in said
    whole = ran["fit"][2]
    assert content["parameters"] == whole["parameters"]
    assert "prediction_error" in json.dumps(whole)
    assert "agreement: " not in said


def test_compare_says_where_the_model_fails(ran):
    result, _, content = ran["compare"]
    assert "fails most in cart_position of forced_3" in result.stdout
    assert {row["experiment"] for row in content["experiments"]} == {"forced_3"}


@pytest.mark.parametrize("command", ["diagnose", "improve"])
def test_a_command_begins_with_a_saved_fit_and_keeps_its_result(ran, command):
    result, path, kept = ran[f"{command} --model"]
    assert result.exit_code == 0, result.output
    assert f"saved: {path}" in result.stdout
    loaded = est.load(path)
    if command == "improve":
        assert loaded.verdict == "missing"
        assert str(loaded.diagnoses[0]) == str(kept[("diagnose", "diagnose")])
        assert list(loaded.final.model.ids) == [*loaded.base.model.ids[:2], "flexible_mode", *loaded.base.model.ids[2:]]
        assert loaded.headline == "flexible_mode was missing; the mended model was not diagnosed again."
        assert loaded.headline in result.stdout
    else:
        assert "The fit is that of base.h5." in " ".join(result.stdout.split())
        assert str(loaded) == str(kept[("diagnose", "diagnose")])
        assert loaded.effects[0].id == "flexible_mode"
        assert str(loaded.additions[0]) == str(kept[("diagnose", "diagnose")].additions[0])


def test_several_saved_models_are_judged_side_by_side(ran):
    result, folder, content = ran[SEVERAL]
    assert result.exit_code == 0, result.output
    said = " ".join(result.stdout.split())
    assert "base fails most in cart_position of forced_3" in said
    assert "mended fails most in" in said
    base, mended = content["models"]
    assert [base["label"], mended["label"]] == ["base", "mended"]
    errors = [model["error"]["validation"]["cart_position"]["rms_over_noise"] for model in (base, mended)]
    assert errors[0] > 5
    assert errors[1] < 1.5
    assert mended["parameters"]["flexible_mode.frequency"]["value"] == pytest.approx(37.4, rel=0.01)
    assert {row["model"] for row in content["experiments"]} == {"base", "mended"}
    page = " ".join(html.unescape(re.sub(r"<[^>]+>", " ", (folder / "report.html").read_text())).split())
    assert "mended follows the data best: the model leaves at most" in page
    assert "Next. Nothing: mended follows these data to their noise." in page
    assert {path.name for path in folder.glob("residuals_*.png")} == {"residuals_1.png", "residuals_2.png"}


def test_a_file_that_holds_no_model_is_named(ran, file, tmp_path):
    path = ran["diagnose --model"][1]
    refused(call("improve", file, "--model", path), 2, "holds a Diagnosis", "give a model, a fit or an improvement")
    refused(call("compare", file, "--model", file), 2, "--model: ", "holds no model or result")
    refused(call("fit", file, "--save", tmp_path / "fit.txt"), 2, "--save", "end in .h5")
    refused(call("compare", file, "--model", path, "--model", path), 2, "twice")
