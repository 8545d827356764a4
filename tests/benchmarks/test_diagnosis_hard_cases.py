"""Hard cases of the diagnosis study are recorded as their names say."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

from rtac_jax.effects import CATALOGUE
from rtac_jax.effects.one_sided_spring import GROSS as SCREENED

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from diagnosis_cases import hidden_in, kind_of
from diagnosis_hard_cases import HARD, MISTAKEN, SHORT, recording_of

sys.path.pop(0)


def test_every_case_hides_an_effect_or_nothing():
    for kind, cases in HARD.items():
        for name in cases:
            assert kind_of(name) == kind
            if kind != "mistaken":
                assert set(hidden_in(name)) <= {*CATALOGUE, *SCREENED, "nothing"}


def test_a_short_recording_is_half_of_four_runs():
    recording = recording_of(SHORT["short: nothing"], 7, 0)
    assert sorted(e.kind for e in recording) == ["forced", "free", "rest"]
    assert {e.duration for e in recording if e.kind != "rest"} == {2.0}


@pytest.mark.parametrize(
    ("name", "group", "channel", "factor"),
    [
        ("current of the other sign", "inputs", "current", -1.0),
        pytest.param("positions in tenths of a metre", "outputs", "cart_position", 10.0, marks=pytest.mark.slow),
        pytest.param("speed of the other sign", "outputs", "arm_velocity", -1.0, marks=pytest.mark.slow),
    ],
)
def test_a_mistake_changes_one_channel(name, group, channel, factor):
    right, wrong = (recording_of(case, 7, 0) for case in (SHORT["short: nothing"], MISTAKEN[f"mistaken: {name}"]))
    for one, other in zip(right, wrong, strict=True):
        for place in ("inputs", "outputs"):
            for c, signal in getattr(one, place).items():
                by = factor if (place, c) == (group, channel) else 1.0
                np.testing.assert_array_equal(getattr(other, place)[c].values, by * signal.values)


def test_a_wrong_mass_changes_nothing_else():
    right, wrong = (recording_of(c, 7, 0) for c in (SHORT["short: nothing"], MISTAKEN["mistaken: mass ten times"]))
    assert wrong.rig["total_mass"] == 10.0 * right.rig["total_mass"]
    assert dataclasses.replace(wrong, rig=right.rig) == right
