"""A tachometer that reads a velocity while the arm stands still is said so, and its noise is not."""

import numpy as np
import pytest
import scipy.signal

from rtac_jax.measurement import Experiment, Recording, concerns


def noise(seed: int, correlation: float) -> np.ndarray:
    """Two seconds of it at 500 Hz, 0.05 rad/s."""
    white = np.random.default_rng(seed).normal(0.0, 0.05, 1100)
    return scipy.signal.lfilter([np.sqrt(1 - correlation**2)], [1.0, -correlation], white)[100:]


def said(velocity: np.ndarray, **how: str) -> list[str]:
    kind = "free" if how else "rest"
    position = np.round(1e-4 * np.sin(0.02 * np.arange(len(velocity))), 6) if how else np.full(len(velocity), 1e-6)
    one = Experiment.of("run", kind=kind, sample_time=0.002, cart_position=position, arm_velocity=velocity, **how)
    return [text for text in concerns(Recording((one,), {"total_mass": 1.0})) if "the arm stands still" in text]


@pytest.mark.parametrize("how", [{}, {"arm": "locked"}])
def test_a_bias_is_named_with_its_size(how: dict[str, str]) -> None:
    (sentence,) = said(0.2 + noise(1, 0.0), **how)
    read = sentence.split("reads ")[1].split(" rad/s")[0].split(" +- ")
    assert abs(float(read[0]) - 0.2) < 4 * float(read[1])
    assert 0.001 < float(read[1]) < 0.003


@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_noise_of_any_colour_about_zero_is_none(correlation: float) -> None:
    assert sum(bool(said(noise(seed, correlation))) for seed in range(100)) <= 1


def test_less_than_a_step_of_the_converter_is_none() -> None:
    assert not said(0.1 * np.round((0.04 + noise(2, 0.0)) / 0.1))
    assert said(0.1 * np.round((0.24 + noise(2, 0.0)) / 0.1))
