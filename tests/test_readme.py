"""The examples of the README run as they stand."""

import re
from pathlib import Path

import pytest

import rtac_jax as rtac

BLOCKS = re.findall(r"```python\n(.*?)```", Path(__file__).parents[1].joinpath("README.md").read_text(), re.DOTALL)


def test_the_fifteen_line_example_finds_what_it_says(capsys: pytest.CaptureFixture[str]) -> None:
    assert len(BLOCKS[0].strip().splitlines()) <= 16
    names: dict[str, object] = {}
    exec(BLOCKS[0].replace("rtac.configure()", ""), names)
    printed = capsys.readouterr().out
    assert "Missing: cubic_spring" in printed
    comparison = names["est"].compare([names["fit"], names["better"]], names["validation"])  # type: ignore[attr-defined]
    before, after = (m.errors["cart_position"].rms_over_noise for m in comparison.models)
    assert after < 1.2
    assert before > 2 * after


def test_the_other_examples_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for block in BLOCKS[1:]:
        exec(block, {})
    assert rtac.Recording.load("rig.h5").rig["total_mass"] == 1.23
