"""What can be learned from a recording."""

from estimators._agreement import Agreement, agreement
from estimators._attribution import SOURCES, Attribution
from estimators._batched_output_error import BatchFit, output_error_batch
from estimators._candidate import Candidate
from estimators._compare import Comparison, compare
from estimators._control_design import ControlDesign, control
from estimators._diagnose import Diagnosis, diagnose
from estimators._effect_cost import EffectCost, effect_cost
from estimators._envelope import Envelope, envelope
from estimators._expected import Expected, expected_std
from estimators._frequency_response import frequency_responses
from estimators._improve import Improvement, improve
from estimators._least_squares import AS_IN_PAPER, ClosedForm, least_squares
from estimators._linear_equality import Equality, Trend
from estimators._linear_model import LinearModel
from estimators._linear_residuals import ResidualTest
from estimators._next_experiment import NextExperiment, PlannedExperiment, next_experiment
from estimators._nonlinear_prediction_error import PredictorFit, prediction_error_nonlinear
from estimators._output_error import Fit, output_error
from estimators._prediction_error import LinearModels, prediction_error
from estimators._profile import Profile, profile
from estimators._response_record import FrequencyResponse, FrequencyResponses
from estimators._results import RESULTS, DivergedError, NotIdentifiableError
from estimators._sandwich import Covariances, covariances

__all__ = [
    "AS_IN_PAPER",
    "RESULTS",
    "SOURCES",
    "Agreement",
    "Attribution",
    "BatchFit",
    "Candidate",
    "ClosedForm",
    "Comparison",
    "ControlDesign",
    "Covariances",
    "Diagnosis",
    "DivergedError",
    "EffectCost",
    "Envelope",
    "Equality",
    "Expected",
    "Fit",
    "FrequencyResponse",
    "FrequencyResponses",
    "Improvement",
    "LinearModel",
    "LinearModels",
    "NextExperiment",
    "NotIdentifiableError",
    "PlannedExperiment",
    "PredictorFit",
    "Profile",
    "ResidualTest",
    "Trend",
    "agreement",
    "compare",
    "control",
    "covariances",
    "diagnose",
    "effect_cost",
    "envelope",
    "expected_std",
    "frequency_responses",
    "improve",
    "least_squares",
    "next_experiment",
    "output_error",
    "output_error_batch",
    "prediction_error",
    "prediction_error_nonlinear",
    "profile",
]
