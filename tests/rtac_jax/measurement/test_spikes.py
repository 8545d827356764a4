"""Spikes of one to three samples are found where they are, and nowhere else."""

import numpy as np
import pytest

from rtac_jax.measurement import Signal, _momentary_faults, spikes

TIME = 0.005 * np.arange(800)


@pytest.fixture
def values():
    return 5e-3 * np.cos(10.0 * TIME) + 2e-5 * np.random.default_rng(0).standard_normal(len(TIME))


@pytest.mark.parametrize("width", [1, 2, 3])
def test_a_spike_is_found_with_its_width(values, width):
    values[300 : 300 + width] += 1e-3
    assert spikes(values).tolist() == list(range(300, 300 + width))


def test_places_count_gaps_and_a_longer_fault_is_none(values):
    values[100:120] = np.nan
    assert spikes(values).size == 0
    values[300:302] -= 1e-3
    values[500:540] += 1e-3
    assert spikes(values).tolist() == [300, 301]


def test_too_short_or_constant_a_channel_has_none():
    assert spikes(np.zeros(800)).size == 0
    assert spikes(np.ones(10)).size == 0


@pytest.mark.parametrize("rate", [6.9995, 7.003, 13.004])
def test_an_encoder_that_moves_by_nearly_whole_counts_loses_no_samples(rate):
    """It shows no noise, and a count more or less now and then; what is lost is more."""
    count, place = 2 * np.pi / 2000, np.arange(1200)
    moved = np.where(place < 200, rate * place**2 / 400, rate * (place - 100))
    angle = count * np.floor(moved + 0.3)
    assert list(_momentary_faults.momentary_faults("arm_angle", Signal(angle, "rad"))) == []
    lost = np.delete(angle, slice(700, 704))
    (said,) = _momentary_faults.momentary_faults("arm_angle", Signal(lost, "rad"))
    assert "samples were lost there" in said
