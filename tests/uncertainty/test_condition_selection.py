"""Which conditions of a recording an envelope is made of, and what is left out of it, by name."""

from dataclasses import replace

import numpy as np
import pytest
from operating_conditions import RIG, SAMPLE_TIME, recorded, smooth

import estimators as est
from estimators.frequency_response.estimate import DrownedError
from estimators.reporting.envelope import remarks
from estimators.uncertainty.condition_selection import usable_conditions
from rtac_jax.measurement import Experiment, Recording, multisine, positive_negative
from rtac_jax.virtual_rig import Plan, record


@pytest.mark.slow
def test_models_whose_response_is_known_nowhere_are_left_out_and_named(monkeypatch):
    def shown(one):
        if one.name in hidden:
            raise DrownedError(f"/experiments/{one.name}: the excitation hardly moves it")

    monkeypatch.setattr("estimators.uncertainty.condition_selection.check_shown", shown)
    hidden = {"condition_2"}
    found = usable_conditions(smooth(), modes=1)
    assert [one.name for one in found.responses] == ["condition_1", "condition_3", "condition_4"]
    assert list(found.left_out) == ["condition_2"]
    assert found.models is not None
    assert len(found.models.models) == 4  # it was fitted like the others
    hidden = {"condition_2", "condition_3", "condition_4"}
    with pytest.raises(ValueError, match=r"only condition_1 shows .* two conditions; .*condition_3.*hardly moves"):
        usable_conditions(smooth(), modes=1)


def test_what_shows_no_response_is_left_out_and_named():
    first, second, third, fourth = (recorded()[f"condition_{n}"] for n in range(1, 5))
    pushed = Experiment.of(
        "pushed", kind="forced", sample_time=SAMPLE_TIME, disturbance_force=first.inputs["current"].values,
        cart_position=first.outputs["cart_position"].values,
    )  # fmt: skip
    again = replace(first, name="again", repeat_of="condition_1")
    blind = replace(third, name="blind", outputs={"arm_angle": third.outputs["arm_angle"]})
    silent = replace(
        fourth, name="nowhere", outputs={"cart_position": fourth.outputs["cart_position"]}, initial_arm_angle=None
    )
    turning = replace(second, outputs={c: s for c, s in second.outputs.items() if c != "arm_angle"})
    found = usable_conditions(Recording((first, turning, again, blind, pushed, silent)))
    assert found.integrated == ("condition_2",)
    text = " ".join(remarks(est.envelope(found.responses, within_db=60.0, progress=False), found))
    assert "angle of condition_2 was integrated" in text
    assert [one.name for one in found.responses] == ["condition_1", "condition_2"]
    assert set(found.left_out) == {"again", "blind", "pushed", "nowhere"}
    assert "repeats condition_1" in found.left_out["again"]
    assert "no current" in found.left_out["pushed"]
    assert "no motion of the cart" in found.left_out["blind"]
    assert "arm's angle" in found.left_out["nowhere"]


def test_arms_near_ninety_degrees_have_their_condition_and_what_they_cannot_show_is_said():
    """The whole workspace: the response from i cos(theta) is one and the same, and known ever less towards 90 degrees."""
    wave = positive_negative(multisine(samples=500, sample_time=0.02, rms=0.005, band=(1.0, 6.0), seed=3))
    angles = (0.0, 1.0, 1.42, np.pi / 2)
    plans = [
        Plan(f"condition_{n + 1}", "forced", 20.0, 0.02, wave, initial_angle=angle) for n, angle in enumerate(angles)
    ]
    found = usable_conditions(record(replace(RIG, cart_coulomb=0.0), plans, seed=2, step=1e-3))
    assert found.without_grip == ("condition_3", "condition_4")
    assert found.grips["condition_3"] == pytest.approx(np.cos(1.42), abs=0.05)
    shares = [float(np.median(one.std / np.abs(one.response))) for one in found.responses]
    assert np.all(np.diff(shares) > 0), "the less the arm grips the cart, the less is known"
    assert shares[-1] > 5 * shares[0]
    text = " ".join(remarks(est.envelope(found.responses, within_db=60.0, progress=False), found))
    assert f"Arm near ±90°: condition_3 (cos θ of 0.11 rms; known to {100 * shares[2]:.0f} %), condition_4 (" in text
    assert "not the gain from current to cart" in text
    everywhere = usable_conditions(smooth())
    assert everywhere.without_grip == ()
