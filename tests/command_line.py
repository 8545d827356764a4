"""`rtac` as a user calls it, and what every refusal and every report keeps to."""

import json
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from estimators.cli import app as cli
from rtac_jax.measurement import Recording
from rtac_jax.virtual_rig import Rig, record, standard_plans

COMMANDS = ("fit", "compare", "diagnose", "improve")


def hidden_mode() -> Recording:
    """A small recording of a rig with a second body on its cart.

    Three of its experiments are trained on: what they compile serves the four of the README and of `rtac demo`, and the reverse.
    """
    rig = Rig(flexible_mass=0.12, flexible_damping=0.03, position_noise=2e-6, quantisation_bits=16)
    return record(rig, standard_plans(seed=3, duration=4.0, free=1, forced=3, rest=1), seed=3)


def call(*arguments):
    """Runs `rtac` in this process, so that compiled code is shared; nothing but an exit may leave it."""
    result = CliRunner().invoke(cli.app, [str(a) for a in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def refused(result, status, *words):
    assert result.exit_code == status, result.output
    assert result.stdout == ""
    assert "Traceback" not in result.output
    assert len(result.stderr.strip().splitlines()) == 1
    for word in words:
        assert word in result.stderr


def reported(command, file, out: Path, *options):
    """What a command on a file says, the folder of its report, and its JSON, which must hold no NaN."""
    result = call(command, file, "--out", out / "new", "--json", out / "result.json", *options)
    assert result.exit_code == 0, result.output
    return result, out / "new", json.loads((out / "result.json").read_text(), parse_constant=pytest.fail)


def check_report(result, folder, content):
    """Every picture twice, a page that needs nothing but itself, nothing half written; gives the names of the pictures."""
    assert (content["format"], content["version"]) == ("rtac-report", 1)
    assert content["seconds"] > 0
    names = {path.name for path in folder.iterdir()}
    assert "report.html" in names
    assert not any("part" in name for name in names)
    images = {name.removesuffix(".png") for name in names if name.endswith(".png")}
    assert images == {name.removesuffix(".svg") for name in names if name.endswith(".svg")}
    page = (folder / "report.html").read_text()
    assert "http://" not in page
    assert "https://" not in page
    assert len(re.findall(r'src="data:image/png;base64,', page)) == len(images)
    assert not re.search(r"\bnan\b", result.stdout)
    return images
