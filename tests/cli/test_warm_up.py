"""`rtac warm-up`: what it compiles, another process and another number of experiments find."""

import os
import subprocess
import sys
from pathlib import Path

from command_line import call, refused

ROOT = Path(__file__).parents[2]


def _process(folder: Path, *options: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", "estimators.cli.app", "warm-up", *options],
        cwd=ROOT, env=os.environ | {"JAX_COMPILATION_CACHE_DIR": str(folder)}, capture_output=True, text=True, timeout=300,
    )  # fmt: skip


def test_another_size_finds_what_was_compiled(tmp_path: Path) -> None:
    first = _process(tmp_path, "--experiments", "4", "--samples", "250", "--hidden", "")
    assert first.returncode == 0, first.stderr
    assert f"{tmp_path} holds" in first.stdout
    row = next(line for line in first.stdout.splitlines() if "nothing" in line)
    assert row.split()[:3] == ["4", "250", "nothing"]
    assert "adequate" in row
    programs = {path.name for path in (tmp_path / "programs").rglob("_f*-*")}
    assert {name.split("-")[0] for name in programs} >= {"_factors", "_filter"}
    again = _process(tmp_path, "--experiments", "3", "--samples", "300", "--hidden", "")
    assert again.returncode == 0, again.stderr
    assert {path.name for path in (tmp_path / "programs").rglob("_f*-*")} == programs


def test_what_is_no_size_and_no_effect_is_refused() -> None:
    refused(call("warm-up", "--samples", "3"), 2, "--samples is '3'", "200 or more")
    refused(call("warm-up", "--experiments", "2.5"), 2, "--experiments is '2.5'", "whole numbers")
    refused(call("warm-up", "--hidden", "nonsense"), 2, "--hidden names nonsense", "cubic_spring")
