"""The ablation counts the verdicts that a rule changes, for better or worse against what the rig hides."""

import importlib
import shutil
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]
KEPT = ROOT / "tests" / "data" / "evidence"
NAMES = {
    "effect": "096_tacho_ripple",
    "pair": "097_gravity_tilt_+_torque_droop",
    "outside": "097_outside_friction_along_the_way",
    "nothing": "096_nothing,_white_noise",
}


@pytest.fixture(scope="module")
def ablate_policy() -> ModuleType:
    sys.path.insert(0, str(ROOT / "benchmarks"))
    try:
        return importlib.import_module("ablate_policy")
    finally:
        sys.path.pop(0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("evidence")
    for kept, name in NAMES.items():
        shutil.copy(KEPT / f"{kept}.json", found / f"{name}.json")
    return found


def test_a_rule_switched_off_is_counted_where_it_changes_a_verdict(ablate_policy: ModuleType, folder: Path) -> None:
    table = ablate_policy.ablation(ablate_policy.evidence_of_protocols(folder))
    rows = {
        cells[1].strip(): [c.strip() for c in cells[2:-1]] for cells in (line.split("|") for line in table.splitlines())
    }
    assert "switched off (4 recordings)" in rows
    changed, better, worse, as_good, _ = rows["effects: named at most (1)"]
    assert (changed, better, worse, as_good) == ("1", "", "1", "")  # one of a pair is a part of the truth
    assert rows["close: refitted beside the first (0)"][0] == ""


def test_the_kinds_of_case_are_told_apart(ablate_policy: ModuleType, folder: Path) -> None:
    said = ablate_policy.rates(ablate_policy.evidence_of_protocols(folder), ablate_policy.by_policy())
    assert set(said.splitlines()) == {
        "effects: {'right': 1}", "pairs: {'right': 1}", "outside: {'unknown': 1}", "nothing: {'adequate': 1}",
    }  # fmt: skip


def test_one_currency_judges_the_same_evidence(ablate_policy: ModuleType, folder: Path) -> None:
    kept = ablate_policy.evidence_of_protocols(folder)
    told = {name: ablate_policy.one_currency(2.0)(evidence) for (name, *_), evidence in kept.items()}
    assert told["nothing, white noise"].verdict == "adequate"
    assert told["tacho_ripple"].effects == ("tacho_ripple",)
