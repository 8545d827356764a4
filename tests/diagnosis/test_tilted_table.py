"""A tilted table whose position sensor was zeroed at rest, wholly or in part: the arm shows gravity, the cart does not."""

import dataclasses
import math

import pytest
from hidden_effects import diagnosed

import rtac_jax as rtac
from rtac_jax import virtual_rig
from rtac_jax.effects import CATALOGUE

TILT = 0.0384  # rad
RIG = virtual_rig.Rig(tilt_along=TILT)
SAG = RIG.total_mass * 9.81 * math.sin(TILT) / RIG.spring_stiffness
FEW = [CATALOGUE[name] for name in ("gravity_tilt", "cogging", "arm_coulomb", "cable_spring", "tacho_ripple")]
SHAKEN = dict(force_noise=1e-3, torque_noise=3e-5)


def recorded(*, zeroed: float, duration: float = 5.0, **rig: float) -> rtac.Recording:
    plans = virtual_rig.standard_plans(seed=5, duration=duration, free=2, forced=4, rest=1, repeats=1)
    return virtual_rig.record(dataclasses.replace(RIG, lvdt_offset=-zeroed * SAG, **rig), plans, seed=77)


@pytest.mark.slow
def test_gravity_is_named_by_what_it_does_to_the_arm() -> None:
    found = diagnosed(recorded(zeroed=1.0, duration=3.0), FEW)
    assert found.verdict == "missing", found
    assert [c.id for c in found.effects] == ["gravity_tilt"], found
    estimates = found.effects[0].parameters
    assert estimates["zeroed"].value == 1.0
    assert estimates["along"].value == pytest.approx(math.sin(TILT), abs=5 * estimates["along"].std)
    assert estimates["along"].std < 0.01 * TILT


@pytest.mark.slow
@pytest.mark.parametrize(
    ("zeroed", "rig", "names", "left"),
    [
        (0.6, SHAKEN, {"gravity_tilt", "force_offset", "lvdt_offset"}, set()),
        (1.0, SHAKEN, {"gravity_tilt"}, set()),
        (1.0, dict(current_lag=0.008), {"gravity_tilt", "current_lag"}, {"delayed force", "static force"}),
    ],
)
def test_gravity_is_named_beside_the_offset_that_is_left(
    zeroed: float, rig: dict[str, float], names: set[str], left: set[str]
) -> None:
    """Of a constant force and an offset of the sensor nothing tells which it is.

    Beside a lag, what is left (27 and 33, where both effects explain 8,800) rejects by p-values next to their levels.
    """
    found = diagnosed(recorded(zeroed=zeroed, **rig))
    assert {c.id for c in found.effects} == names, found
    assert found.removed > 0.95, found
    rejecting = [test for test in found.left if test.rejects]
    assert {test.test for test in rejecting} <= left, found
    assert all(test.excess < 0.01 * sum(c.bic_gain for c in found.effects) for test in rejecting), found


def test_a_tilt_steeper_than_a_wall_says_what_is_known_instead() -> None:
    """Of an arm alone only its torque of gravity shows, and the paper's eccentric moment may be far from its own."""
    body = rtac.RTAC.paper().body
    steep = CATALOGUE["gravity_tilt"](along=0.0, across=43.3).remark(body)
    assert (
        "a torque of 0.45 N m. Where the arm's plane is vertical, eccentric_moment is 0.0459 kg m: give it in /rig"
        in steep
    )
    assert steep.startswith("gravity_tilt of 43.3 is no sine")
    assert CATALOGUE["gravity_tilt"](along=0.0, across=1.0).remark(body) == ""


def test_an_offset_of_the_drive_says_what_is_the_same_while_the_arm_moves() -> None:
    body = rtac.RTAC.paper().body
    torque = 0.01 * float(body.torque_constant)
    assert f"dry friction that is {torque:.3g} N m more one way" in CATALOGUE["current_offset"](-0.01).remark(body)
