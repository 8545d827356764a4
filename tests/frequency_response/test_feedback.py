"""Frequency responses say where the input answers the noise of the output, and nothing of rigs that are played open loop."""

import numpy as np
import pytest
from looped_plant import looped

import estimators as est
import rtac_jax as rtac
from estimators.frequency_response.feedback import feedback
from rtac_jax import virtual_rig
from rtac_jax.measurement import Recording


@pytest.fixture(scope="module", autouse=True)
def _double() -> None:
    rtac.configure()


@pytest.mark.parametrize(("gain", "least"), [(0.0, 0.0), (40.0, 0.3)])
def test_a_controller_in_the_loop_is_said(gain: float, least: float) -> None:
    recording = Recording(tuple(looped(seed, gain, 0.05 if gain else 0.2) for seed in range(8)), {})
    found = est.frequency_responses(recording, compensate=False, band=(0.3, 8.0))
    assert all(one.feedback >= least for one in found)
    assert bool(found.remarks()) == (gain > 0)
    assert ("as with a controller in the loop (run_0" in str(found)) == (gain > 0)
    assert ("8 answer the noise of the output" in found.plot().get_suptitle().replace("\n", " ")) == (gain > 0)
    if gain:
        assert "run_5 and 2 more" in found.remarks()[0]


@pytest.mark.parametrize(
    "rig",
    [
        virtual_rig.Rig(),
        virtual_rig.Rig(force_noise=1e-2, torque_noise=1e-4, cubic_spring=2e5),
        virtual_rig.Rig(arm_coulomb=1e-3, current_lag=0.01),
    ],
    ids=["friction", "shaken", "arm_friction"],
)
def test_a_rig_that_is_played_is_not(rig: virtual_rig.Rig) -> None:
    """Dry friction, an arm that turns, random forces: nothing that a linear prediction leaves makes the input follow it."""
    plans = virtual_rig.standard_plans(seed=5, sample_time=0.005, duration=8.0, free=0, forced=4)
    for one in virtual_rig.record(rig, plans, seed=6):
        if one.kind != "forced":
            continue
        played = one.inputs["current"].values
        for signal in one.outputs.values():
            assert feedback(played, played, signal.values, held=True) == 0.0


def test_chance_is_no_feedback_whatever_the_colour_of_the_input() -> None:
    random = np.random.default_rng(3)
    lines = 2 * np.pi * np.arange(1, 120)[:, None] / 1000 * np.arange(1000)
    for _ in range(200):
        played = np.sum(np.cos(lines + random.uniform(0, 2 * np.pi, (119, 1))), axis=0)
        out = np.convolve(played, 0.9 ** np.arange(100) * np.sin(0.3 * np.arange(100)))[:1000]
        assert feedback(played, played, out + 0.05 * np.std(out) * random.normal(size=1000), held=True) == 0.0
