"""Fits that begin at values that somebody gave, near enough to be followed."""

import dataclasses
from typing import Any

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from estimators.output_error import descent
from rtac_jax import virtual_rig


@pytest.mark.slow
@pytest.mark.parametrize("frequency", [45.0, 50.0])
def test_a_mode_is_found_from_a_frequency_some_way_off(frequency: float) -> None:
    """The simulation begins far above the noise, yet follows the motion; led by predictions it ended at 63 and 556 rad/s."""
    rig = virtual_rig.Rig(
        flexible_mass=0.12, flexible_frequency=37.4, flexible_damping=0.03, cart_coulomb=0.0, encoder=True
    )
    plans = virtual_rig.standard_plans(
        seed=4, sample_time=0.005, duration=10.0, free=0, forced=3, rest=1, current_rms=0.05
    )
    quiet = dataclasses.replace(rig, position_noise=2e-6, quantisation_bits=16)
    recording = virtual_rig.record(quiet, plans, seed=4)
    model = rtac.RTAC.from_rig(recording).without("cart_coulomb")
    without = est.output_error(model, recording, from_model=True, progress=False)
    mode = rtac.effects.FlexibleMode(mass=0.06, frequency=frequency, damping=0.05)
    found = est.output_error(without.model + mode, recording, from_model=True, progress=False).parameters
    for name, true in (("mass", 0.12), ("frequency", 37.4), ("damping", 0.03)):
        assert found[f"flexible_mode.{name}"].value == pytest.approx(true, rel=0.02)


def test_a_fit_that_crept_far_from_the_data_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    recording = virtual_rig.record(
        virtual_rig.Rig(), virtual_rig.standard_plans(seed=3, duration=2.0, free=2, forced=0), seed=3
    )
    original, beyond = descent.solve_bounded, []

    def crept(*given: Any, **options: Any) -> Any:
        beyond.append(options["far"])
        return original(*given, **options)._replace(converged=False, crept=True)

    monkeypatch.setattr(descent, "solve_bounded", crept)
    locked = dataclasses.replace(
        recording,
        experiments=tuple(
            dataclasses.replace(e, arm="locked", outputs={"cart_position": e.outputs["cart_position"]})
            for e in recording
        ),
    )
    fit = est.output_error(rtac.RTAC.from_rig(locked), locked, from_model=True, progress=False)
    assert fit.result == est.RESULTS.crept
    assert set(beyond) == {10.0}
    assert "only crept on, far from the data; ask est.diagnose" in fit.outcome
    assert "came to rest" not in fit.outcome


def test_states_that_are_given_are_where_the_fit_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    """From values of the model alone: what is found in closed form begins at the first samples."""
    recording = virtual_rig.record(
        virtual_rig.Rig(), virtual_rig.standard_plans(seed=3, duration=2.0, free=2, forced=0, rest=0), seed=3
    )
    model = rtac.RTAC.from_rig(recording)
    states = {e.name: np.array([0.01, 0.02, 0.3, 0.0]) for e in recording}
    original, begun = descent.space_of, []

    def spied(*given: Any, **options: Any) -> Any:
        begun.append(original(*given, **options))
        return begun[-1]

    monkeypatch.setattr(descent, "space_of", spied)
    est.output_error(model, recording, from_model=True, start=states, steps=1, progress=False)
    np.testing.assert_array_equal(np.asarray(begun[0].start).T, np.stack(list(states.values())))
    begun.clear()
    est.output_error(model, recording, start=states, steps=1, progress=False)
    assert [np.allclose(np.asarray(space.start)[1], 0.02) for space in begun[:2]] == [False, True]
