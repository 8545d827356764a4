"""The correlation of residuals with the input, and the band in which an independent input stays."""

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.validation.simulation_error import Trace


def coloured(kind, samples, seed):
    """Noise with the colour of a drifting sensor, or of a lightly damped mode at 37.4 rad/s."""
    white = np.random.default_rng(seed).standard_normal(samples + 2000)
    radius = np.exp(-0.03 * 37.4 * 0.005)
    poles = {"drift": [1, -0.95], "mode": [1, -2 * radius * np.cos(37.4 * 0.005), radius**2]}[kind]
    return lfilter([1.0], poles, white)[2000:]


def correlated(residual, current):
    at = 0.005 * np.arange(len(residual))
    one = Trace("a", "cart_position", at, residual, 0 * at, current, at >= 0, 1.0)
    return one.cross_correlation(50)


@pytest.mark.parametrize(("residual", "current"), [("drift", "drift"), ("mode", "drift"), ("drift", "mode")])
def test_one_in_a_hundred_correlations_with_an_independent_input_is_outside_its_band(residual, current):
    """Coloured on both sides, where a band for white noise leaves tens of percent outside."""
    outside, outside_white = [], []
    for seed in range(150):
        found, band = correlated(coloured(residual, 4000, (seed, 0)), coloured(current, 4000, (seed, 1)))
        outside.append(np.mean(np.abs(found) > band))
        outside_white.append(np.mean(np.abs(found) > 2.58 / np.sqrt(4000)))
    assert 0.002 < np.mean(outside) < 0.03
    assert np.mean(outside_white) > 0.1


def test_an_input_that_acts_late_shows_at_its_lag():
    current = np.random.default_rng(0).standard_normal(4000)
    late = np.concatenate([np.zeros(7), current[:-7]])
    found, band = correlated(coloured("drift", 4000, 1) + late, current)
    assert np.argmax(found) == 7
    assert found[7] > 2 * band
    assert np.sum(np.abs(found) > band) < 6
    # Half of the residual missing: what is left still shows it.
    gaps = np.where(np.arange(4000) % 400 < 200, coloured("drift", 4000, 1) + late, np.nan)
    found, band = correlated(gaps, current)
    assert np.argmax(found) == 7
    assert found[7] > band


def test_an_input_that_stands_still_correlates_with_nothing():
    found, band = correlated(coloured("drift", 400, 0), np.ones(400))
    assert not np.any(found)
    assert band == pytest.approx(2.576 / 20, rel=1e-3)
