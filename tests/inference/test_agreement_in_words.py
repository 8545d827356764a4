"""What an agreement says: which assumption fails, what is nearly a disagreement, and what may hide behind random forces."""

import dataclasses

import numpy as np
import pytest

from estimators.inference.agreement import Agreement, Disagreement
from estimators.inference.simulation_residual import simulation_residual


def test_verdict_names_the_assumption_that_fails() -> None:
    names, units = ("spring_stiffness", "torque_constant"), ("N/m", "N m/A")
    pair = Disagreement(("a", "b"), np.array([9.0, 0.1]), np.zeros(2), np.ones(2), np.array([1e-12, 0.9]), 1e-11)
    one = Agreement(
        names,
        units,
        ("a", "b"),
        ("each moment", "the whole"),
        np.ones((2, 2)),
        np.ones((2, 2)),
        (pair,),
        0.01,
        80,
        False,
        {},
    )
    assert one.differing == ("spring_stiffness",)
    assert "the spring is linear" in one.verdict
    assert "torque is proportional" not in one.verdict
    assert "both for each moment and for the whole" in one.verdict
    assert one.suspects[0] == "cubic_spring"
    assert not [effect for effect in one.suspects if effect.startswith("force_")]
    driven = dataclasses.replace(one, channels=("cart_position", "disturbance_force"))
    assert "and the applied force acts as it was recorded" in driven.verdict
    assert driven.suspects[-5:] == ("force_delay", "force_lag", "force_saturation", "force_dead_zone", "force_droop")


def agreed(p_values: tuple[float, ...], *, std: float = 0.01) -> Agreement:
    """Build an agreement of three estimates of the inertia 1, with these p-values of the pairs."""
    one = np.ones(1)
    pairs = tuple(
        Disagreement(labels, 0.1 * one, 0 * one, std * one, p * one, p)
        for labels, p in zip((("a", "b"), ("a", "c"), ("b", "c")), p_values, strict=True)
    )
    ask = ("the motion",) * 3
    whole, unit = np.ones((3, 1)), ("kg m^2",)
    return Agreement(("arm_inertia",), unit, ("a", "b", "c"), ask, whole, whole, pairs, 0.01, 80, False, {})


def test_what_is_nearly_a_disagreement_confirms_nothing() -> None:
    """At a level of 1 % shared by three pairs 0.0058 is no disagreement, and no agreement either."""
    found = agreed((0.5, 0.0058, 0.9))
    assert not found.rejected
    assert found.verdict == (
        "No two disagree at the level of 1 %, but a and c differ, most clearly in arm_inertia, as they would by chance in 0.58 % "
        "of such recordings, and with 3 pairs one as large in 1.7 %: that confirms nothing, and a longer recording decides it."
    )
    assert "nearly do" in found.plot().get_suptitle()
    assert agreed((0.5, 0.018, 0.9)).verdict.startswith("They agree")
    assert agreed((0.5, 0.0032, 0.9)).rejected


def test_estimates_that_know_nothing_confirm_nothing() -> None:
    assert "tells nothing of" not in agreed((0.5, 0.6, 0.9), std=0.29).verdict
    vague = agreed((0.5, 0.6, 0.9), std=0.31).verdict
    assert "That tells nothing of arm_inertia: a difference would have to be larger than 30 % to show." in vague


@pytest.mark.parametrize(
    ("torque", "of_the_current", "hides"),
    [(0.02, False, True), (0.005, False, False), (0.02, True, False)],
    ids=["random forces", "next to none", "noise of the current"],
)
def test_nothing_hides_behind_random_forces_that_are_nothing_or_are_known(
    torque: float, of_the_current: bool, hides: bool
) -> None:
    found = simulation_residual(
        {"arm_angle": 1.0}, {"arm_angle": 1.0}, {"arm_angle": 90.0}, random=(0.0, torque), samples_per_radian=20.0,
        experiments=3, of_the_current=of_the_current,
    )  # fmt: skip
    by_predictions = dataclasses.replace(
        agreed((0.5, 0.6, 0.9)), labels=("closed form", "output error", "prediction error"), simulation=found
    )
    assert by_predictions.verdict.endswith("est.diagnose tells the two apart.") is hides
    assert not agreed((0.5, 0.6, 0.9)).verdict.endswith("tells the two apart."), "without a predictor none are counted"
