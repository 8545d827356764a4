"""Correlations of prediction errors with the input at negative lags: feedback, which no test of the model counts."""

import numpy as np

from estimators.linear.residual_tests import residual_test, whitened

COUNT, LATER = 1500, 3


def test_an_input_that_follows_the_errors_shows_at_negative_lags_only() -> None:
    random = np.random.default_rng(1)
    jacobian = random.normal(size=(COUNT, 2))
    inside = []
    for draw in range(40):
        error, own = random.normal(size=(2, COUNT))
        for fed_back in (0.0, 0.5):
            signal = own + fed_back * np.append(np.zeros(LATER), error[:-LATER])
            found = residual_test(error, signal, np.ones(COUNT), jacobian, whitened(error), noise_parameters=0)
            assert len(found.feedback_correlation) == len(found.autocorrelation) == 25
            beyond = np.abs(found.feedback_correlation) > found.feedback_band
            if fed_back:
                assert beyond[LATER - 1]
                assert np.argmax(np.abs(found.feedback_correlation)) == LATER - 1
            else:
                inside.append(1 - np.mean(beyond))
        assert found.cross_p > 1e-4, f"draw {draw}: the test of the model counts lags from zero on"
    assert np.mean(inside) > 0.97
