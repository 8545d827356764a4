"""One estimate and one standard deviation, by the rule that is stated."""

import dataclasses

import numpy as np
import pytest
from made_up_results import NOISE, compared

from estimators.core.fisher_information import Information
from estimators.core.fit import Fit
from estimators.core.results import RESULTS
from estimators.inference.robust_covariance import Covariances
from estimators.prediction_error.fit import PredictorFit, Whiteness
from estimators.validation.recommendation import recommended
from rtac_jax import RTAC
from rtac_jax.prior import Prior

MODEL = RTAC.paper()
NAMES = ("spring_stiffness", "torque_constant")


def information(*std):
    return Information(NAMES, np.diag(np.square(std)), np.eye(2), np.ones(2))


FIT = Fit(MODEL, RESULTS.successful, information(0.1, 1e-4), NOISE, NOISE, {}, ("free_1", "forced_1"), {})
SPREAD = Covariances(
    NAMES, np.array([132.6, 0.08]), ("N/m", "N m/A"), np.diag([0.1**2, 1e-8]), np.diag([0.3**2, 4e-8]),
    np.diag([0.2**2, np.nan]), {},
)  # fmt: skip


def predictor(p_value, counted=1.0):
    """Predictions whose innovations have this probability of being white, of this fraction of the samples."""
    found = object.__new__(PredictorFit)
    model = MODEL.with_values({"spring_stiffness": 130.0})
    white = Whiteness("free_1", "cart_position", 1.0, np.zeros(25), 0.1, p_value)
    known = {
        "model": model,
        "information": information(0.5, 2e-4),
        "whiteness": (white,),
        "statistics": {"counted": counted},
    }
    for name, value in known.items():
        object.__setattr__(found, name, value)
    return found


def test_a_white_residual_is_served_best_by_output_error():
    alike = dataclasses.replace(SPREAD, sandwich=np.diag([0.15**2, 1e-8]))
    found = recommended(FIT, compared("model", 0.0), predicted=predictor(0.5), spread=alike)
    assert (found.estimator, found.sound) == ("output error", True)
    assert found.parameters["spring_stiffness"].std == pytest.approx(0.1)


def test_a_colour_that_few_samples_hide_from_a_test_counts():
    """Three steps of 61 samples: deviations of 3.9e-5 for a white residual, 1.4e-4 for a coloured one, and 6e-4 off."""
    found = recommended(FIT, compared("model", 0.0), spread=SPREAD)
    assert (found.estimator, found.sound) == ("output error", False)
    assert found.parameters["spring_stiffness"].std == pytest.approx(0.3)
    unsure = dataclasses.replace(FIT, information=information(300.0, 1e-4))
    hardly = dataclasses.replace(SPREAD, sandwich=np.diag([900.0**2, 1e-8]))
    assert recommended(unsure, compared("model", 0.0), spread=hardly).sound, "of what is not known no deviation counts"


def test_a_coloured_one_by_predictions_if_these_are_white():
    found = recommended(FIT, compared("model", 5.0), predicted=predictor(0.5), spread=SPREAD)
    assert (found.estimator, found.sound) == ("prediction error", True)
    assert dataclasses.astuple(found.parameters["spring_stiffness"])[:2] == pytest.approx((130.0, 0.5))


def test_not_if_these_are_of_a_few_samples_as_of_a_rig_that_rests():
    found = recommended(FIT, compared("model", 5.0), predicted=predictor(0.5, counted=0.34), spread=SPREAD)
    assert (found.estimator, found.sound) == ("output error", False)
    assert found.parameters["spring_stiffness"].std == pytest.approx(0.3)
    refused = dataclasses.replace(FIT, result=RESULTS.steps_exhausted)
    found = recommended(refused, compared("model", 5.0), predicted=predictor(0.5, counted=0.34), spread=SPREAD)
    assert (found.estimator, found.sound) == ("prediction error", False)
    assert "which it has of fewer than half of the samples" in str(found)


@pytest.mark.parametrize(("std", "told"), [(0.5, True), (2.0, False)])
@pytest.mark.parametrize(("p_value", "left"), [(0.5, 1.0), (1e-9, 100.0)])
def test_a_constant_that_predictions_take_far_from_what_was_measured_is_told(std, told, p_value, left):
    predicted = predictor(p_value)
    model = RTAC(predicted.model.body, predicted.model.effects, priors={"spring_stiffness": Prior(132.6, std)})
    object.__setattr__(predicted, "model", model)
    fit = dataclasses.replace(FIT, residual_std={channel: left * noise for channel, noise in NOISE.items()})
    found = recommended(fit, compared("model", 5.0), predicted=predicted, spread=SPREAD)
    assert found.estimator == "prediction error"
    words = f"spring_stiffness ended at 130, 5.2 stated standard deviations from the 132.6 +- {std:g} of the recording"
    assert (words in found.sentence) == told


COLOURED = {
    (True, True): "though nothing is found missing",
    (False, True): "what it does not name, or random forces",
    (False, False): "est.diagnose tells whether it can be named",
}


@pytest.mark.parametrize(("adequate", "diagnosed"), COLOURED)
def test_a_coloured_residual_is_no_reason_to_ask_what_was_asked(adequate, diagnosed):
    found = recommended(FIT, compared("model", 5.0), spread=SPREAD)
    found = dataclasses.replace(found, adequate=adequate, diagnosed=diagnosed)
    assert not found.sound
    assert [words for words in COLOURED.values() if words in found.sentence] == [COLOURED[adequate, diagnosed]]
    white = dataclasses.replace(found, sound=True).sentence
    assert not any(words in white for words in COLOURED.values())


@pytest.mark.parametrize(("p_value", "sound"), [(0.5, True), (1e-9, False)])
def test_an_output_error_that_did_not_converge_is_not_recommended_beside_predictions(p_value, sound):
    astray = dataclasses.replace(FIT, result=RESULTS.steps_exhausted)
    found = recommended(astray, compared("model", 0.0), predicted=predictor(p_value), spread=SPREAD)
    assert (found.estimator, found.sound) == ("prediction error", sound)
    assert recommended(astray, compared("model", 0.0), spread=SPREAD).sound is False


@pytest.mark.parametrize("predicted", [None, predictor(1e-9)])
def test_where_nothing_is_white_the_larger_robust_deviation_is_given_and_the_reader_told(predicted):
    found = recommended(FIT, compared("model", 5.0), predicted=predicted, spread=SPREAD)
    assert (found.estimator, found.sound) == ("output error", False)
    assert found.parameters["spring_stiffness"].std == pytest.approx(0.3)
    assert found.parameters["torque_constant"].std == pytest.approx(2e-4)  # one cluster alone tells nothing
    assert found.parameters["total_mass"].std == 0.0
    lines = str(found).splitlines()
    assert lines[0].split() == ["parameter", "value", "std", "unit"]
    assert ["spring_stiffness", "132.6", "0.3", "N/m"] in [line.split() for line in lines]
    assert ["total_mass", "1.23", "fixed", "kg"] in [line.split() for line in lines]
    assert lines[-1] == found.sentence
    assert "or as something is missing, which no deviation counts" in found.sentence
    assert "no estimate is right" not in found.sentence
    assert "spring_stiffness" in found._repr_html_()


def test_of_a_model_that_does_not_follow_the_rig_no_estimate_is_called_right():
    far = dataclasses.replace(FIT, residual_std={channel: 30.0 * level for channel, level in NOISE.items()})
    found = recommended(far, compared("model", 30.0), spread=SPREAD)
    assert found.estimator == "output error"
    assert "being left at 30 times the noise: where the model lacks something no estimate is right" in found.sentence


def test_a_simulation_that_is_far_off_is_not_recommended_beside_predictions():
    """Where a missing effect or random forces lead the simulation astray, predictions are bent less."""
    far = dataclasses.replace(FIT, residual_std={channel: 30.0 * level for channel, level in NOISE.items()})
    found = recommended(far, compared("model", 30.0), predicted=predictor(1e-9), spread=SPREAD)
    assert (found.estimator, found.sound) == ("prediction error", False)
    assert "output error does not follow the rig, being left at 30 times the noise" in found.sentence
    assert dataclasses.astuple(found.parameters["spring_stiffness"])[:2] == pytest.approx(
        (130.0, 0.5)
    )  # its own is larger
    assert found.parameters["torque_constant"].std == pytest.approx(2e-4)


@pytest.mark.parametrize(
    ("times", "adequate", "diagnosed", "told"),
    [
        (
            30.0,
            False,
            False,
            "left at 30 times the noise. Where random forces shake the rig these are right all the same",
        ),
        (30.0, False, True, "whatever its deviation."),
        (30.0, True, True, ""),
        (1.0, False, False, ""),
    ],
)
def test_predictions_of_what_no_simulation_follows_are_no_comfort(times, adequate, diagnosed, told):
    """Random forces may stand for what the model lacks, and take its parameters along."""
    far = dataclasses.replace(FIT, residual_std={channel: times * level for channel, level in NOISE.items()})
    found = recommended(far, compared("model", 30.0), predicted=predictor(0.5), spread=SPREAD)
    found = dataclasses.replace(found, adequate=adequate, diagnosed=diagnosed)
    assert found.estimator == "prediction error"
    assert told in found.sentence
    assert ("But no simulation follows the rig" in found.sentence) == bool(told)
    assert ("est.diagnose looks for that" in found.sentence) == (bool(told) and not diagnosed)


def test_coloured_innovations_of_what_no_simulation_follows_are_not_called_right():
    far = dataclasses.replace(FIT, residual_std={channel: 30.0 * level for channel, level in NOISE.items()})
    found = recommended(far, compared("model", 30.0), predicted=predictor(1e-9), spread=SPREAD)
    assert "right all the same" not in found.sentence
    assert "Where random forces stand for what the model lacks no estimate is right" in found.sentence
    refused = dataclasses.replace(far, result=RESULTS.steps_exhausted)
    found = recommended(refused, compared("model", 30.0), predicted=predictor(0.5), spread=SPREAD)
    assert "no simulation follows" not in found.sentence
