"""Effects that a user keeps in a file reach the diagnosis and the loop of the command line."""

from pathlib import Path
from typing import Any

import pytest
from small_experiments import forced, free
from typer.testing import CliRunner

import estimators as est
from estimators.cli import app as cli
from estimators.cli.own_effects import with_own
from rtac_jax.effects import CATALOGUE
from rtac_jax.measurement import Recording

RECORDING = Recording((free("free_1"), free("free_2"), forced("forced_1"), forced("forced_2")), {"total_mass": 1.23})
OWN = """
from rtac_jax import parameter
from rtac_jax.effects import CubicSpring, Force


class Magnet(Force):
    id, equation, source, port, nature = "magnet", "-k q^5", "own rig", "cart", "conservative"
    k: object = parameter(symbol="k", unit="N/m^5", meaning="stiffness", null=0.0, plausible=1e9)

    def force(self, motion, own):
        return -self.k * motion.cart_position**5, 0.0
"""


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    path = tmp_path / "mine.py"
    path.write_text(OWN)
    return path


def test_what_a_file_defines_is_offered_beside_the_catalogue(mine: Path) -> None:
    offered = with_own(mine)
    assert offered is not None
    assert [c.id for c in offered] == [*CATALOGUE, "magnet"]  # what it only imports is not offered twice
    assert with_own(None) is None


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"none\.py: there is no such file; give a Python file"):
        with_own(tmp_path / "none.py")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("import gremlins", "cannot be run: ModuleNotFoundError"),
        ("def (", "SyntaxError"),
        ("x = 1", "defines no effect"),
        (OWN.replace('"magnet"', '"cogging"'), "cogging occurs twice"),
    ],
)
def test_a_file_without_effects_is_wrong_use(tmp_path: Path, text: str, said: str) -> None:
    RECORDING.save(tmp_path / "rig.h5")
    (tmp_path / "wrong.py").write_text(text)
    result = CliRunner().invoke(
        cli.app, ["diagnose", str(tmp_path / "rig.h5"), "--effects", str(tmp_path / "wrong.py")]
    )
    assert result.exit_code == 2, result.output
    assert len(result.stderr.strip().splitlines()) == 1
    assert said in result.stderr


@pytest.mark.parametrize("command", ["diagnose", "improve"])
def test_a_command_hands_them_on(mine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str) -> None:
    seen: list[str] = []

    def asked(*_: Any, candidates: Any, **__: Any) -> Any:
        seen.extend(c.id for c in candidates)
        raise ValueError("enough")

    monkeypatch.setattr(est, "output_error", lambda *_, **__: None)
    monkeypatch.setattr(est, command, asked)
    RECORDING.save(tmp_path / "rig.h5")
    result = CliRunner().invoke(cli.app, [command, str(tmp_path / "rig.h5"), "--effects", str(mine)])
    assert "enough" in result.stderr, result.output
    assert seen[-1] == "magnet"
