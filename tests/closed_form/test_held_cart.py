"""Runs in which dry friction holds the cart tell no spring, and do not lead a fit astray."""

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from estimators.closed_form.fit import starting_values
from rtac_jax import virtual_rig

STEP = 0.004
TRUTH = {"spring_stiffness": 390.0, "cart_viscous.coefficient": 2.5, "cart_coulomb.level": 9.0}


@pytest.fixture(scope="module")
def recording() -> rtac.Recording:
    """Two decays that end in a swing or two, and two runs whose drive is half of what friction holds."""
    rig = virtual_rig.Rig(
        total_mass=1.77, spring_stiffness=390.0, cart_viscous=2.5, cart_coulomb=9.0, position_range=0.08,
        quantisation_bits=14, position_noise=4e-6,
    )  # fmt: skip
    plans = [
        virtual_rig.Plan(f"decay_{n}", "free", 2.0, STEP, initial_position=x, arm="locked")
        for n, x in ((1, 0.06), (2, -0.05))
    ]
    time = STEP * np.arange(500)
    plans += [
        virtual_rig.Plan(f"held_{n}", "forced", 2.0, STEP, disturbance_force=4.0 * np.sin(n * time), arm="locked")
        for n in (3, 5)
    ]
    return virtual_rig.record(rig, plans, seed=5)


def test_they_do_not_count_in_the_closed_form(recording: rtac.Recording) -> None:
    """A count of an encoder under 4 N was a spring of half a million N/m."""
    decays = recording.select(["decay_1", "decay_2"])
    all_of_it, moving = (starting_values(rtac.RTAC.from_rig(told), told) for told in (recording, decays))
    for name in TRUTH:
        assert float(np.asarray(all_of_it[name])) == float(np.asarray(moving[name]))
    # Without the sign of a friction that stops it in half a swing the closed form is a start, and no more.
    assert 1.0 < float(np.asarray(all_of_it["spring_stiffness"])) / TRUTH["spring_stiffness"] < 10.0


def test_a_fit_beside_them_ends_at_the_truth(recording: rtac.Recording) -> None:
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    for name, truth in TRUTH.items():
        assert fit.parameters[name].value == pytest.approx(truth, rel=0.02)


def test_it_is_said_that_they_do_not_count(recording: rtac.Recording) -> None:
    found = est.least_squares(rtac.RTAC.from_rig(recording), recording)
    assert set(found.skipped) == {"held_3", "held_5"}
    assert "dry friction holds the cart" in found.skipped["held_3"]


def test_what_no_experiment_tells_is_no_result(recording: rtac.Recording) -> None:
    """The model's own stiffness stood in the table of the closed form, as if it had come of the data."""
    held = recording.select(["held_3", "held_5"])
    told = str(est.least_squares(rtac.RTAC.from_rig(held), held))
    spring = next(line for line in told.splitlines() if line.startswith("Spring stiffness"))
    assert "not told" in spring
    assert "not told" not in next(line for line in told.splitlines() if line.startswith("Total mass"))
