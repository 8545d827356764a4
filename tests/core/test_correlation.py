"""Correlations of residuals: bands that hold as often as they say, both signs of lag, and gaps."""

import numpy as np
import pytest
import scipy.signal

from estimators.core.correlation import autocovariance, cross_correlation, whiteness
from estimators.validation.trace import colour_of

COUNT, DRAWS = 600, 300


def test_autocovariance_is_the_sum_of_products() -> None:
    x = np.random.default_rng(0).normal(size=50)
    np.testing.assert_allclose(autocovariance(x, 7), [x[k:] @ x[: 50 - k] / 50 for k in range(8)], atol=1e-14)


def test_the_test_of_whiteness_rejects_as_often_as_it_says() -> None:
    """Also where a third of the samples is missing."""
    random = np.random.default_rng(1)
    for missing in (0.0, 0.3):
        p_values, inside = [], []
        for _ in range(DRAWS):
            present = (random.uniform(size=COUNT) >= missing).astype(float)
            found = whiteness(random.normal(size=COUNT) * present, present)
            p_values.append(found.p_value)
            inside.append(np.mean(np.abs(found.autocorrelation) < found.band))
        assert 0.06 < np.mean(np.array(p_values) < 0.1) < 0.15
        assert np.mean(inside) > 0.97
    coloured = scipy.signal.lfilter([1.0], [1.0, -0.5], random.normal(size=COUNT))
    assert whiteness(coloured, np.ones(COUNT)).p_value < 1e-6


def test_a_band_holds_for_coloured_signals_that_are_independent() -> None:
    random = np.random.default_rng(2)
    outside = []
    for _ in range(DRAWS):
        error, signal = (scipy.signal.lfilter([1.0], [1.0, -0.9], random.normal(size=COUNT)) for _ in range(2))
        found = cross_correlation(error, signal, 20)
        outside.append(np.mean(np.abs(found.values) > found.band))
    assert np.mean(outside) < 0.03  # 1 %, and the band is itself estimated


@pytest.mark.parametrize("later", [4, -4])
def test_the_sign_of_a_lag_tells_response_from_feedback(later: int) -> None:
    signal = np.random.default_rng(3).normal(size=COUNT)
    found = cross_correlation(np.roll(signal, later), signal, 10)
    assert found.lags[np.argmax(found.values)] == later
    assert found.outside >= (later > 0)
    assert found.outside <= 1 + (later > 0)
    assert found.values.max() > 0.95


@pytest.mark.parametrize("stride", [4, 40])
def test_a_channel_read_every_nth_sample_is_tested_at_its_own_rate(stride: int) -> None:
    """Of 25 lags in samples none, or few, would be asked: everything would be white."""
    random = np.random.default_rng(3)
    present = np.zeros(60 * stride)
    present[1::stride] = 1.0
    rejected = {0.0: 0, 0.8: 0}
    for colour in rejected:
        for _ in range(200):
            values = np.zeros(len(present))
            values[1::stride] = scipy.signal.lfilter([1.0], [1.0, -colour], random.normal(size=60))
            rejected[colour] += whiteness(values, present, 15).p_value < 0.1
    assert 8 <= rejected[0.0] <= 36  # a tenth of 200, five deviations to either side
    assert rejected[0.8] >= 190


def test_where_nothing_can_be_tested_nothing_is_called_white() -> None:
    once = np.zeros(50)
    once[7] = 1.0
    assert np.isnan(whiteness(once, once).p_value)
    assert [colour_of(p) for p in (0.5, 1e-3, float("nan"), None)] == ["white", "not white", "not tested", "not tested"]
