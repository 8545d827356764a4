"""What prediction errors say of feedback: correlations with the input at negative lags, and at lag 0 where the input is held."""

import numpy as np
import pytest
from looped_plant import looped

import estimators as est
import rtac_jax as rtac
from estimators.linear.residual_tests import residual_test, whitened
from rtac_jax.measurement import Recording

COUNT, LATER = 1500, 3


def test_an_input_that_follows_the_errors_shows_at_negative_lags_only() -> None:
    random = np.random.default_rng(1)
    jacobian = random.normal(size=(COUNT, 2))
    inside, alone = [], []
    for draw in range(40):
        error, own = random.normal(size=(2, COUNT))
        for fed_back in (0.0, 0.5):
            signal = own + fed_back * np.append(np.zeros(LATER), error[:-LATER])
            found = residual_test(error, signal, np.ones(COUNT), jacobian, whitened(error), noise_parameters=0)
            assert len(found.feedback_correlation) == len(found.autocorrelation) == 25
            beyond = np.abs(found.feedback_correlation) > found.feedback_band
            assert found.fed_back == bool(fed_back)
            if fed_back:
                assert beyond[LATER - 1]
                assert np.argmax(np.abs(found.feedback_correlation)) == LATER - 1
            else:
                inside.append(1 - np.mean(beyond))
                alone.append(found.feedback_p)
        assert found.cross_p > 1e-4, f"draw {draw}: the test of the model counts lags from zero on"
    assert np.mean(inside) > 0.97
    assert 0.3 < np.mean(alone) < 0.7


@pytest.mark.parametrize("gain", [pytest.param(0.0, marks=pytest.mark.slow), 40.0])
def test_a_controller_that_acts_in_the_same_sample_is_feedback_and_no_missing_dynamics(gain: float) -> None:
    """A spring and mass under u = r - L y, with L a gain behind a filter; the noise of the sensor goes round the loop."""
    rtac.configure()
    experiments = [looped(seed, gain) for seed in range(6)]
    found = est.prediction_error(Recording(tuple(experiments), {}), compensate=False, progress=False)
    assert [one.residuals.fed_back for one in found] == [gain > 0] * 6
    assert sum("raise modes" in one.verdict for one in found) == 0
    assert all(("controller in the loop" in one.verdict) == (gain > 0) for one in found)
    away = np.array([(one.values[0] - 10.0) / one.std[0] for one in found])
    assert np.sqrt(np.mean(away**2)) < 1.6
