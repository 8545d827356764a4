"""Estimates of a recording whose experiments differ in length, sample time and channels, and what is said of them."""

import numpy as np
import pytest
from unequal_recordings import RIG, TRUTH, near, unequal

import estimators as est
import rtac_jax as rtac


@pytest.fixture(scope="module")
def model():
    return rtac.RTAC.from_rig(unequal())


@pytest.fixture(scope="module")
def fit(model):
    return est.output_error(model, unequal(), progress=False)


@pytest.fixture(scope="module")
def predictor(model):
    return est.prediction_error_nonlinear(model, unequal(), progress=False)


def deviations(found):
    return {name: (found.parameters[name].value - truth) / found.parameters[name].std for name, truth in TRUTH.items()}


@pytest.mark.parametrize("weak", [False, True])
def test_each_closed_form_estimate_is_that_of_its_experiment(model, weak):
    found = est.least_squares(model, unequal(), weak=weak)
    assert not found.skipped
    for name in ("spring_stiffness", "cart_viscous.coefficient"):
        assert found.estimates[name].pooled == pytest.approx(TRUTH[name], rel=0.2)
    moment = found.estimates["eccentric_moment"]
    assert moment.names == ("forced_1", "forced_2", "forced_3")
    assert moment.pooled == pytest.approx(RIG.eccentric_moment, rel=0.1)
    # With `weak`, dry friction of all tells where the cart turns in each.
    both = est.least_squares(model, unequal(), weak=weak, reaction=False).estimates["spring_stiffness"]
    for name, value in zip(both.names, both.each, strict=True):
        alone = est.least_squares(model, unequal().select([name, "rest_1"]), weak=weak, reaction=False)
        near(alone.estimates["spring_stiffness"].each[0], value, rtol=1e-5 if weak else 1e-8)


def test_covariances_count_each_experiment_as_it_was_sampled(fit):
    found = est.covariances(fit, unequal())
    plain, sandwich, clustered = (
        np.array(list(found.std(kind).values())) for kind in ("plain", "sandwich", "clustered")
    )
    # The noise is white and the model right.
    assert np.all((sandwich / plain > 0.5) & (sandwich / plain < 2.0))
    assert np.all(np.isfinite(clustered) & (clustered > 0))


@pytest.mark.slow
def test_predictions_reach_the_truth(predictor):
    assert max(abs(x) for x in deviations(predictor).values()) < 4.0
    assert all(0.8 < w.rms < 1.2 for w in predictor.whiteness)
    assert min(w.p_value for w in predictor.whiteness) > 1e-4


@pytest.mark.slow
def test_closed_form_and_output_error_agree(model, fit):
    assert max(abs(x) for x in deviations(fit).values()) < 4.0
    closed = est.least_squares(model, unequal(), weak=True)
    found = est.agreement([closed, fit], unequal(), draws=40, progress=False)
    assert not found.rejected, str(found)


@pytest.mark.slow
def test_all_estimators_agree(model, fit, predictor):
    closed = est.least_squares(model, unequal(), weak=True)
    several = [closed, fit, predictor, est.prediction_error(unequal(), progress=False)]
    found = est.agreement(several, unequal(), draws=40, progress=False)
    assert not found.rejected, str(found)
    shown = np.isfinite(found.values)
    assert np.all(found.std[shown] > 0)
    # By replicates or by curvature, a deviation is the same.
    row = found.labels.index("output error")
    told = np.array([fit.parameters[n].std if n in fit.parameters else np.nan for n in found.names])
    both = np.isfinite(told) & np.isfinite(found.values[row])
    ratio = found.std[row][both] / told[both]
    assert np.all((ratio > 0.5) & (ratio < 2.0))
