"""How the study records rigs otherwise than usual, and how it counts what came of it."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

import rtac_jax as rtac
from rtac_jax.measurement.plan import Plan
from rtac_jax.virtual_rig import Rig

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import diagnosis_cases
import diagnosis_evidence as evidence
import diagnosis_protocols
from diagnosis_protocols import PROTOCOLS, plans_of, recorded

sys.path.pop(0)


def made(name: str) -> tuple[rtac.Recording, list[Plan]]:
    protocol = dataclasses.replace(PROTOCOLS[name], duration=2.0)
    plans = plans_of(protocol, seed=1, rest=1, repeats=1, played=None)
    return recorded(protocol, Rig(**protocol.sensors), plans, seed=2), plans


@pytest.mark.slow
def test_the_current_in_the_loop_is_what_the_measured_velocity_asks_for() -> None:
    recording, plans = made("closed loop")
    forced = [plan for plan in plans if plan.kind == "forced"]
    assert len(forced) == PROTOCOLS["closed loop"].forced
    for plan in forced:
        assert plan.current is not None
        one = recording[plan.name]
        asked = plan.current - PROTOCOLS["closed loop"].feedback * one.outputs["arm_velocity"].values
        np.testing.assert_allclose(one.inputs["current"].values, asked, rtol=0, atol=1e-8)
        assert np.max(np.abs(asked - plan.current)) > 1e-3
    assert not any("current" in e.inputs for e in recording if e.kind == "free")


def test_a_loop_that_does_not_settle_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnosis_protocols, "_ROUNDS", 2)
    with pytest.raises(ArithmeticError, match="still changes by"):
        made("closed loop")


def test_a_channel_is_left_out_of_every_experiment() -> None:
    recording, _ = made("encoder, no tachometer")
    assert {tuple(e.outputs) for e in recording} == {("cart_position", "arm_angle")}


def test_weighed_constants_are_off_and_say_by_how_much() -> None:
    recording, _ = made("weighed constants")
    rig, known, stated = Rig(), recording.rig, recording.rig_std
    for name, share in PROTOCOLS["weighed constants"].constants_std.items():
        assert stated[name] == pytest.approx(share * getattr(rig, name))
        assert 0 < abs(known[name] - getattr(rig, name)) < 4 * stated[name]


@pytest.mark.parametrize(
    ("case", "named", "worth"),
    [
        (diagnosis_cases.NULL, ("tacho_ripple",), "right"),
        (diagnosis_cases.NULL, (), "unknown"),
        (diagnosis_cases.NULL, ("cogging",), "wrong"),
        ("cubic_spring", ("cubic_spring", "tacho_ripple"), "right"),
        ("cubic_spring", ("cubic_spring",), "a part"),
        ("cubic_spring", ("tacho_ripple",), "a part"),
        ("tacho_ripple", ("tacho_ripple",), "right"),
        # What is missing beside the ripple is in no catalogue: naming the ripple says nothing of it.
        ("outside: eddy brake", ("tacho_ripple",), "wrong"),
    ],
)
def test_what_every_rig_of_a_protocol_has_is_to_be_named_too(case: str, named: tuple[str, ...], worth: str) -> None:
    told = evidence.as_result(case, "missing" if named else "unknown", named, dict.fromkeys(named, ()))
    assert diagnosis_cases.outcome(told, also=PROTOCOLS["coarse tachometer with ripple"].also) == worth


def test_an_offset_that_nothing_drives_is_named_as_a_torque() -> None:
    free, usual = PROTOCOLS["free only"], PROTOCOLS["usual"]
    for name, in_free, in_usual in (("torque_offset", "right", "wrong"), ("current_offset", "wrong", "right")):
        told = evidence.as_result("current_offset", "missing", (name,), {name: ()})
        assert diagnosis_cases.outcome(told, free.also, free.stands_for) == in_free
        assert diagnosis_cases.outcome(told, usual.also, usual.stands_for) == in_usual


def test_protocols_have_folders_of_their_own(tmp_path: Path) -> None:
    folders = {evidence.folder_of(tmp_path, name) for name in PROTOCOLS}
    assert len(folders) == len(PROTOCOLS)
    assert evidence.evidence_path(tmp_path, "cubic_spring", 96).parent == evidence.folder_of(tmp_path, "usual")
