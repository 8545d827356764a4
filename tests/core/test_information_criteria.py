"""Information criteria against the textbook's formulas and against fresh data."""

import numpy as np
import pytest
import scipy.stats

from estimators.core.information_criteria import InformationCriteria


def test_the_criteria_are_those_of_the_gaussian_likelihood() -> None:
    random = np.random.default_rng(0)
    errors = {"cart_position": 2e-5 * random.normal(size=300), "arm_velocity": 0.1 * random.normal(size=200)}
    rms = {c: float(np.sqrt(np.mean(e**2))) for c, e in errors.items()}
    found = InformationCriteria.of_rms(rms, {c: len(e) for c, e in errors.items()}, 5)
    value = sum(np.sum(scipy.stats.norm.logpdf(e, scale=rms[c])) for c, e in errors.items())
    assert found.log_likelihood == pytest.approx(value, rel=1e-12)
    assert found.aic == pytest.approx(-2 * value + 2 * 7, rel=1e-12)  # two variances are estimated too
    assert found.bic == pytest.approx(-2 * value + 7 * np.log(500), rel=1e-12)
    assert found.fpe["arm_velocity"] == pytest.approx(rms["arm_velocity"] ** 2 * (500 + 7) / (500 - 7), rel=1e-12)


def test_the_final_prediction_error_is_that_of_fresh_data() -> None:
    """For a regression with 20 parameters on 100 samples, over many draws."""
    random = np.random.default_rng(1)
    x = random.normal(size=(100, 20))
    project = x @ np.linalg.pinv(x)
    foretold, fresh = [], []
    for _ in range(400):
        y, again = random.normal(size=(2, 100))
        left = y - project @ y
        found = InformationCriteria(0.0, 20, 100, {"y": float(np.sqrt(np.mean(left**2)))})
        foretold.append(found.fpe["y"])
        fresh.append(np.mean((again - project @ y) ** 2))
    assert np.mean(foretold) == pytest.approx(np.mean(fresh), rel=0.02)
