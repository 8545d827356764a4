"""`rtac demo`, the first thing that a user runs: the loop on a rig that hides the second mode of the paper's section 5.3."""

import json

import pytest
from typer.testing import CliRunner

from estimators.cli import app as cli
from estimators.cli import demo_recording


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("demo") / "out"
    result = CliRunner().invoke(cli.app, ["demo", "--out", str(path), "--json", str(path / "own.json")])
    assert result.exit_code == 0, result.output
    return path


def test_the_hidden_effect_is_named_and_the_error_falls_to_the_noise(folder):
    said = json.loads((folder / "own.json").read_text())
    assert (said["format"], said["version"], said["verdict"]) == ("rtac-report", 1, "missing")
    assert [effect["id"] for effect in said["effects"]] == [demo_recording.HIDDEN]
    validation = said["error"]["validation"]
    assert max(channel["rms_over_noise"] for channel in validation["before"].values()) >= 10
    assert all(channel["rms_over_noise"] <= 1.2 for channel in validation["after"].values())
    truth = demo_recording.demo_rig()
    found = said["effects"][0]["parameters"]
    for name, value in (
        ("mass", truth.flexible_mass),
        ("frequency", truth.flexible_frequency),
        ("damping", truth.flexible_damping),
    ):
        assert found[name]["value"] == pytest.approx(value, rel=0.02), name


def test_everything_is_written(folder):
    written = {path.name for path in folder.iterdir()}
    assert {"demo.h5", "report.html", "own.json"} <= written
    pictures = {path.stem for path in folder.glob("*.png")}
    assert {"diagnosis_1", "improvement", "comparison", "residuals_before", "residuals_after", "recording"} <= pictures
    assert pictures == {path.stem for path in folder.glob("*.svg")}
    assert (folder / "report.html").read_text().count("<img") == len(pictures)
