"""The rounding of an encoder at a steady speed is a line, and says nothing of the model."""

import dataclasses
from typing import Any

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from estimators.diagnosis import innovation_tests
from estimators.misspecification.spectral_line_test import spectral_line
from rtac_jax import virtual_rig
from rtac_jax.effects import CATALOGUE
from rtac_jax.measurement import Experiment

SAMPLES, STEP = 4000, 0.001


def runs() -> list[Experiment]:
    time = STEP * np.arange(SAMPLES)
    return [
        Experiment.of(f"run_{n}", kind="free", sample_time=STEP, arm="locked", cart_position=0.1 * np.sin(time + n))
        for n in range(2)
    ]


def rounding(random: np.random.Generator) -> np.ndarray:
    """What rounding adds to a slide that moves on at a steady speed, 0.2346 counts a sample, in its standard deviations."""
    counts = 0.2346 * np.arange(SAMPLES)[:, None] + random.uniform(size=(1, 2)) + 0.1 * random.normal(size=(SAMPLES, 2))
    return np.sqrt(12.0) * (np.round(counts) - counts)


@pytest.mark.parametrize("rounded", [(), ("cart_position",)])
@pytest.mark.parametrize("vibration", [0.0, 2.0])
def test_only_what_is_stronger_than_all_rounding_is_a_line_of_a_channel_that_is_rounded(
    vibration: float, rounded: tuple[str, ...]
) -> None:
    random = np.random.default_rng(7)
    error = np.zeros((SAMPLES, 3, 2))
    error[:, 0] = rounding(random) + vibration * np.sin(400.0 * STEP * np.arange(SAMPLES))[:, None]
    present = np.zeros_like(error)
    present[:, 0] = 1.0
    found = spectral_line(error, present, runs(), rounded)
    assert (found is not None and found.p_value < 1e-6) == (vibration > 0 or not rounded)
    if vibration:
        assert found is not None
        assert found.frequency == pytest.approx(400.0, abs=2 * np.pi)


@pytest.mark.slow
def test_a_diagnosis_knows_which_channels_are_rounded(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = virtual_rig.Rig(position_noise=1e-9, quantisation_bits=12, position_range=0.05)
    plans = [
        virtual_rig.Plan(f"run_{n}", "free", 2.0, 0.004, initial_position=0.004 + 0.002 * n, arm="locked")
        for n in range(2)
    ]
    made = virtual_rig.record(rig, plans, seed=1)
    stated = [
        dataclasses.replace(
            e, outputs={c: dataclasses.replace(s, noise_std=1e-9) for c, s in e.outputs.items() if c == "cart_position"}
        )
        for e in made
    ]
    recording = dataclasses.replace(made, experiments=tuple(stated))
    told: list[dict[str, float]] = []

    def line(*given: Any) -> None:
        told.append(given[3])

    monkeypatch.setattr(innovation_tests, "spectral_line", line)
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    est.diagnose(fit, recording, candidates=[CATALOGUE["cubic_spring"]], thorough=False, progress=False)
    assert told
    assert all(one["cart_position"] == pytest.approx(0.1 / 2**12) for one in told)
