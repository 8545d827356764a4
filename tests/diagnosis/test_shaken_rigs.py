"""A cut of the study of shaken rigs: what predictions name stays, as no effect brings back what random forces carry away."""

import dataclasses

import pytest

import estimators as est
import rtac_jax as rtac
from estimators.diagnosis import simulation_selection, stepwise_selection
from rtac_jax import virtual_rig

HIDDEN = [
    {}, {"cubic_spring": 6e4}, {"arm_coulomb": 3e-4}, {"current_offset": 0.02}, {"encoder_gain": 1.02}, {"tacho_lag": 0.004},
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("times", [1, 4])
@pytest.mark.parametrize("hidden", HIDDEN, ids=lambda hidden: next(iter(hidden), "nothing"))
def test_simulations_change_no_verdict_on_a_rig_that_is_shaken(
    hidden: dict[str, float], times: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By random forces as large as the study's, or four times; asked of all, also where no name is doubtful."""
    monkeypatch.setattr(simulation_selection, "_is_doubtful", lambda *_: True)
    shaken = {"force_noise": 1e-3 * times, "torque_noise": 3e-5 * times}
    rig = dataclasses.replace(virtual_rig.Rig().drawn(9020 + times), encoder=True, **shaken, **hidden)
    plans = virtual_rig.standard_plans(seed=9020, free=1, forced=3, rest=1, sample_time=0.004, duration=3.0)
    recording = virtual_rig.record(rig, plans, seed=9021)
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    found = est.diagnose(fit, recording, thorough=False, progress=False)
    assert found.evidence is not None
    assert found.evidence.simulated, "simulations were not asked"
    now = est.judge(found.evidence)
    monkeypatch.setattr(stepwise_selection, "selected_by_simulation", lambda *_: None)
    by_predictions = est.judge(found.evidence)
    assert (now.verdict, now.effects) == (by_predictions.verdict, by_predictions.effects)
    assert found.verdict == now.verdict


@pytest.mark.slow
@pytest.mark.parametrize("draw", range(6))
def test_nothing_is_confirmed_on_a_rig_that_is_shaken_and_hides_nothing(draw: int) -> None:
    """With three or four experiments that might confirm what is as large as an alarm, if a thorough diagnosis finds it."""
    times = (0.1, 0.4, 1.6)[draw % 3]
    rig = dataclasses.replace(
        virtual_rig.Rig().drawn(9040 + draw),
        encoder=bool(draw % 2),
        force_noise=1e-3 * times,
        torque_noise=3e-5 * times,
    )
    plans = virtual_rig.standard_plans(seed=9040 + draw, free=1, forced=3, rest=1, sample_time=0.004, duration=3.0)
    recording = virtual_rig.record(rig, plans, seed=9041 + draw)
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    assert est.diagnose(fit, recording, progress=False).verdict == "adequate"
