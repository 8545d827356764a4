"""What the study of the diagnosis calls right: its counts are what users are told of false alarms and power."""

import dataclasses
import json
import sys
import tomllib
from pathlib import Path

import pytest

from rtac_jax import virtual_rig

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import diagnosis_cases
import study_diagnosis as study

sys.path.pop(0)

PAIR = "cubic_spring + arm_coulomb"


def result(case: str, verdict: str, **groups: tuple[str, ...]) -> dict:
    return {
        "case": case, "draw": 34, "verdict": verdict, "steps": list(groups), "groups": {k: list(v) for k, v in groups.items()},
        "effects": list(groups), "validation": {}, "limits": {},
    }  # fmt: skip


@pytest.mark.parametrize(
    ("one", "worth"),
    [
        (result("tacho_lag", "missing", tacho_lag=()), "right"),
        (result("tacho_lag", "ambiguous", tacho_lag=("channel_delay",)), "in the group"),
        (result("tacho_lag", "ambiguous", channel_delay=("tacho_lag",)), "in the group"),
        (result("tacho_lag", "missing", channel_delay=()), "wrong"),
        (result("tacho_lag", "missing", tacho_lag=(), cogging=()), "right and more"),
        (result("tacho_lag", "unknown"), "unknown"),
        (result("tacho_lag", "adequate"), "adequate"),
        (result(PAIR, "missing", arm_coulomb=(), cubic_spring=()), "right"),
        (result(PAIR, "ambiguous", arm_stribeck=("arm_coulomb",), cubic_spring=()), "in the group"),
        (result(PAIR, "missing", arm_coulomb=()), "a part"),
        (result(PAIR, "ambiguous", arm_coulomb=("cubic_spring",)), "a part"),
        (result(PAIR, "missing", arm_coulomb=(), cogging=()), "wrong"),
        # One of two groups cannot stand for both.
        (result(PAIR, "ambiguous", arm_coulomb=("cubic_spring",), cogging=()), "wrong"),
        (result("nothing, white noise", "missing", cogging=()), "wrong"),
        (result("nothing, white noise", "adequate"), "adequate"),
        (result("nothing, coloured noise, no rest, no repeats", "adequate"), "adequate"),
        (result("outside: eddy brake", "missing", cogging=()), "wrong"),
        (result("twice the limit of tacho_lag", "missing", tacho_lag=()), "right"),
    ],
)
def test_what_a_verdict_is_worth(one: dict, worth: str) -> None:
    assert diagnosis_cases.outcome(one) == worth


def test_the_table_counts_every_complete_line_once(tmp_path: Path) -> None:
    file = tmp_path / "results.jsonl"
    lines = [
        result("tacho_lag", "missing", tacho_lag=()), result("tacho_lag", "missing", cogging=()),
        result("cogging", "unknown"), result("nothing, white noise", "adequate"),
    ]  # fmt: skip
    file.write_text("\n".join(json.dumps(one) for one in lines) + '\n{"case": "cog')
    rows = {row.split(" | ")[0].strip("| "): row.split("|")[2:-1] for row in study.table(file).splitlines()[2:]}
    counts = {name: [cell.strip() for cell in row[:8]] for name, row in rows.items()}
    assert counts["tacho_lag"] == ["1", "", "", "", "", "", "1", ""]
    assert rows["tacho_lag"][-1].strip() == "cogging"
    assert counts["**every effect**"] == ["1", "", "", "", "1", "", "1", ""]
    assert counts["**nothing hidden**"] == ["", "", "", "", "", "1", "", ""]


def test_every_case_is_one_of_the_rig() -> None:
    several = diagnosis_cases.EFFECTS | diagnosis_cases.OUTSIDE | diagnosis_cases.NULLS | diagnosis_cases.PAIRS
    plain = virtual_rig.Rig()
    for name, case in several.items():
        rig = dataclasses.replace(plain, **case.hidden)
        assert (rig != plain) == bool(case.hidden), name


def test_what_is_hidden_is_a_multiple_of_the_limit_that_was_stated() -> None:
    null = result(diagnosis_cases.NULL, "adequate") | {"limits": {"tacho_gain": 0.01, "saturation": 4.0}}
    done = {(null["case"], 34): null}
    found = {name: case.hidden for name, _, case in diagnosis_cases.cases(range(34, 35), done, ["limits"])}
    assert found["twice the limit of tacho_gain"] == {"tacho_gain": pytest.approx(1.02)}
    assert found["a third of the limit of saturation"] == {"saturation": pytest.approx(0.75)}
    assert len(found) == 4


def test_the_study_of_the_command_line_hides_what_the_benchmark_hides() -> None:
    """Ten repetitions of each effect, in the same order and of the same size."""
    study = tomllib.loads((Path(__file__).parents[2] / "studies" / "diagnosis.toml").read_text(encoding="utf-8"))
    told = {one["effect"]: one for one in study["plant"]["hidden"]}
    assert list(told)[: len(diagnosis_cases.EFFECTS) + 1] == ["nothing", *diagnosis_cases.EFFECTS]
    assert study["repetitions"] == 10 * len(told)
    for name, case in diagnosis_cases.EFFECTS.items():
        assert (told[name].get("values", {}), told[name].get("played")) == (case.hidden, case.played), name
