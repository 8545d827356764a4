"""A velocity that is made of an encoder's counts is told; one of a tachometer behind a converter is not."""

import numpy as np
import pytest

from rtac_jax.measurement import Experiment, Recording, concerns
from rtac_jax.virtual_rig import Rig, record, standard_plans

SAMPLE_TIME = 0.002
TIME = SAMPLE_TIME * np.arange(-8, 2000)
ANGLE = 3.0 * np.sin(4.0 * TIME) + 0.5 * np.sin(11.3 * TIME)


def said(velocity: np.ndarray, **outputs: np.ndarray) -> list[str]:
    one = Experiment.of(
        "run", kind="forced", sample_time=SAMPLE_TIME, current=np.cos(4.0 * TIME[8:]), arm_velocity=velocity, **outputs
    )
    return [text for text in concerns(Recording((one,), {"total_mass": 1.0})) if "encoder's counts" in text]


def differenced(counts: int, window: int) -> np.ndarray:
    rounded = np.round(ANGLE * counts / (2 * np.pi)) * 2 * np.pi / counts
    return (rounded[8:] - rounded[8 - window : -window]) / (window * SAMPLE_TIME)


@pytest.mark.parametrize(("counts", "window", "told"), [(2048, 1, 2048), (2000, 1, 2000), (500, 4, 2000)])
def test_counts_are_told_with_how_many_make_a_turn(counts: int, window: int, told: int) -> None:
    (sentence,) = said(differenced(counts, window))
    assert sentence.startswith(f"run: arm_velocity moves in steps of a {told}th of a turn in a sample")
    assert "give the counts as arm_angle" in sentence


def test_where_the_angle_is_there_nothing_is_said() -> None:
    assert not said(differenced(2048, 1), arm_angle=np.round(ANGLE[8:] * 326.0) / 326.0)


@pytest.mark.parametrize("step", [40.0 / 2048, 0.1, 0.0123])
def test_a_converter_has_levels_that_are_no_part_of_a_turn(step: float) -> None:
    speed = np.gradient(ANGLE, SAMPLE_TIME)[8:]
    assert not said(np.round(speed / step) * step)


def test_the_virtual_rig_has_a_tachometer() -> None:
    recording = record(Rig(), standard_plans(seed=1, duration=4.0, free=1, forced=2, rest=1), seed=2)
    assert not any("encoder's counts" in text for text in concerns(recording))
