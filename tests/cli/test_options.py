"""The command line where nothing has to be fitted first: what is said and when, `info`, help and options."""

import json
from dataclasses import replace

import pytest
import typer
from command_line import COMMANDS, call, refused

import estimators
import estimators as est
from estimators.cli import job
from estimators.cli.report_page import write_json
from rtac_jax import RTAC
from rtac_jax.measurement import Recording


def test_what_is_said_is_printed_when_the_files_are_written(file, tmp_path, monkeypatch):
    order = []
    monkeypatch.setattr(job, "say", lambda *blocks: order.append((blocks, (tmp_path / "x.json").exists())))
    with job.job(file, None, None, tmp_path / "x.json") as work:
        work.say("the result")
        write_json(work, {"a": 1})
    assert order == [(("the result",), True)]


def test_what_is_said_is_not_lost_where_a_file_cannot_be_written(file, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device", "x.json")

    monkeypatch.setattr("estimators.reporting.html.write_json", full)
    said = []
    monkeypatch.setattr(job, "say", lambda *blocks: said.append(blocks))

    def run():
        with job.job(file, None, None, tmp_path / "x.json") as work:
            work.say("the result of an hour")
            write_json(work, {"a": 1})

    with pytest.raises(typer.Exit):
        run()
    assert said == [("the result of an hour",)]


def test_quick_takes_no_second_look(file, monkeypatch):
    asked = []

    def diagnosed(*_, **options):
        asked.append(options["thorough"])
        raise ValueError("that is enough.")

    monkeypatch.setattr(estimators, "output_error", lambda *_, **__: None)
    monkeypatch.setattr(estimators, "diagnose", diagnosed)
    for flags in ([], ["--quick"]):
        refused(call("diagnose", file, *flags), 1, "that is enough")
    assert asked == [True, False]


def test_quick_improves_without_second_looks(file, monkeypatch):
    asked = []

    def improved(*_, **options):
        asked.append(options["thorough"])
        raise ValueError("that is enough.")

    monkeypatch.setattr(estimators, "improve", improved)
    for flags in ([], ["--quick"]):
        refused(call("improve", file, *flags), 1, "that is enough")
    assert asked == [True, False]


@pytest.mark.parametrize("command", ["diagnose", "improve"])
def test_a_command_ends_its_work_after_some_minutes_or_when_it_is_told(command, file, monkeypatch):
    asked = []

    def found(*_, **options):
        asked.append(options["within"])
        raise ValueError("that is enough.")

    monkeypatch.setattr(estimators, "output_error", lambda *_, **__: None)
    monkeypatch.setattr(estimators, command, found)
    for flags in ([], ["--within", "60"], ["--within", "0"]):
        refused(call(command, file, *flags), 1, "that is enough")
    assert asked == [400.0, 60.0, None]


def test_info_as_json(file, recording, tmp_path):
    result = call("info", file, "--json", tmp_path / "info.json")
    assert result.exit_code == 0
    content = json.loads((tmp_path / "info.json").read_text(), parse_constant=pytest.fail)
    assert content["checksums"] is True
    assert [e["name"] for e in content["experiments"]] == list(recording.names)
    first = content["experiments"][0]
    assert (first["kind"], first["sample_time"], first["repeat_of"]) == ("free", 0.005, None)
    position = recording["free_1"].outputs["cart_position"].values
    assert first["channels"]["cart_position"]["largest"] == position.max()
    assert first["channels"]["cart_position"]["unit"] == "m"
    assert all(sentence in result.stdout for sentence in content["concerns"])


def test_info_describes_and_warns(file):
    result = call("info", file)
    assert result.exit_code == 0
    assert "forced_2" in result.stdout
    assert "concerns" in result.stdout


def test_help_names_every_command():
    result = call("--help")
    assert result.exit_code == 0
    assert all(command in result.stdout for command in (*COMMANDS, "info", "demo"))


def test_names_may_hold_commas(recording):
    odd = replace(recording["free_1"], name="free, slow")
    assert job._names(Recording((odd,)), "free, slow") == ["free, slow"]
    assert job._names(recording, "free_1, forced_1") == ["free_1", "forced_1"]
    assert job._names(recording, None) is None


@pytest.mark.parametrize("progress", [True, False])
def test_a_long_call_shows_a_bar_on_request(recording, capsys, monkeypatch, progress):
    monkeypatch.setattr("estimators.core.progress.watched", lambda: True)
    train, _ = recording.split()  # which was fitted before, so that nothing is compiled anew
    est.output_error(RTAC.from_rig(recording), train, from_model=True, progress=progress)
    said, shown = capsys.readouterr()
    assert said == ""
    assert ("output error from the model's values" in shown and "steps" in shown) if progress else shown == ""
