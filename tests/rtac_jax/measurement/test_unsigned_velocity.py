"""A velocity without a sign is said so; one that has it, or that an arm has which turns one way, is not."""

from collections.abc import Callable

import numpy as np
import pytest

from rtac_jax.measurement import Experiment, Recording, concerns
from rtac_jax.virtual_rig import Rig, record, standard_plans

TIME = 0.005 * np.arange(2000)
NOISE = 0.2 * np.random.default_rng(2).standard_normal(2000)


def said(velocity: np.ndarray, current: np.ndarray) -> list[str]:
    one = Experiment.of(
        "run",
        kind="forced",
        sample_time=0.005,
        current=current,
        arm_velocity=velocity,
        cart_position=1e-3 * np.sin(11.0 * TIME),
    )
    return [text for text in concerns(Recording((one,), {"total_mass": 1.0})) if "comes to nothing" in text]


def test_pulses_that_are_counted_have_no_sign() -> None:
    (sentence,) = said(np.abs(20.0 * np.sin(4.0 * TIME) + NOISE), np.cos(4.0 * TIME))
    assert "arm_velocity comes to nothing 1" in sentence
    assert "counts pulses" in sentence


@pytest.mark.parametrize(
    ("velocity", "current"),
    [
        (lambda t: 20.0 * np.sin(4.0 * t), np.cos),  # has its sign
        (lambda t: 30.0 + 20.0 * np.sin(4.0 * t), np.cos),  # turns one way
        (lambda t: np.abs(20.0 * np.sin(4.0 * t)), lambda t: 1.0 + 0.2 * np.cos(t)),  # is pushed one way
        (lambda t: 20.0 * np.exp(-t), np.cos),  # coasts to a halt
    ],
)
def test_others_have_theirs(velocity: Callable[..., np.ndarray], current: Callable[..., np.ndarray]) -> None:
    assert said(velocity(TIME) + NOISE, current(TIME)) == []


def test_nor_is_a_rig_that_swings_said_so() -> None:
    for seed in range(4):
        recording = record(Rig(), standard_plans(seed=seed, duration=4.0, free=1, forced=3), seed=seed, step=1e-3)
        assert not any("comes to nothing" in text for text in concerns(recording))
