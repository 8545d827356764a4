"""Estimators of a recording: parameters, missing effects, model error and controllers."""

from estimators.closed_form.fit import AS_IN_PAPER, least_squares
from estimators.closed_form.table1 import ClosedForm
from estimators.controller.design import control
from estimators.controller.outcome import ControlDesign
from estimators.core.fit import Fit
from estimators.core.information_criteria import InformationCriteria
from estimators.core.parameter_correlation import ParameterCorrelations
from estimators.core.result_base import load, save
from estimators.core.results import RESULTS, DivergedError, NotIdentifiableError
from estimators.diagnosis.candidate import Candidate
from estimators.diagnosis.diagnose import diagnose
from estimators.diagnosis.diagnosis import Diagnosis
from estimators.diagnosis.evidence import Evidence
from estimators.diagnosis.improve import improve
from estimators.diagnosis.improvement import Improvement
from estimators.diagnosis.policy import DiagnosisPolicy
from estimators.diagnosis.verdict import Judgement, judge
from estimators.experiment_design.next_experiment import NextExperiment, PlannedExperiment, next_experiment
from estimators.frequency_response.estimate import frequency_responses
from estimators.frequency_response.response import FrequencyResponse, FrequencyResponses
from estimators.inference.agreement import Agreement
from estimators.inference.constancy import constancy
from estimators.inference.cramer_rao import Expected, expected_std
from estimators.inference.hausman import agreement
from estimators.inference.model_response import model_response
from estimators.inference.profile_likelihood import Profile, profile
from estimators.inference.robust_covariance import Covariances, covariances
from estimators.linear.fit import LinearModels, prediction_error
from estimators.linear.homogeneity_test import Equality, Trend
from estimators.linear.model import LinearModel
from estimators.linear.residual_tests import ResidualTest
from estimators.output_error.batch import BatchFit, output_error_batch
from estimators.output_error.fit import output_error
from estimators.prediction_error.fit import PredictorFit, prediction_error_nonlinear
from estimators.study import Bootstrap, StudyResults, StudySpec, bootstrap, study
from estimators.uncertainty.attribution import SOURCES, Attribution
from estimators.uncertainty.closed_form_check import ClosedFormCheck, closed_form_check
from estimators.uncertainty.effect_cost import EffectCost, effect_cost
from estimators.uncertainty.envelope import Envelope, envelope
from estimators.validation.channel_consistency import ChannelConsistency, Inconsistency, channel_consistency
from estimators.validation.recommendation import Recommendation, recommended
from estimators.validation.simulation_error import Comparison, compare
from rtac_jax import ResultFileError, __version__

__all__ = [
    "AS_IN_PAPER",
    "RESULTS",
    "SOURCES",
    "Agreement",
    "Attribution",
    "BatchFit",
    "Bootstrap",
    "Candidate",
    "ChannelConsistency",
    "ClosedForm",
    "ClosedFormCheck",
    "Comparison",
    "ControlDesign",
    "Covariances",
    "Diagnosis",
    "DiagnosisPolicy",
    "DivergedError",
    "EffectCost",
    "Envelope",
    "Equality",
    "Evidence",
    "Expected",
    "Fit",
    "FrequencyResponse",
    "FrequencyResponses",
    "Improvement",
    "Inconsistency",
    "InformationCriteria",
    "Judgement",
    "LinearModel",
    "LinearModels",
    "NextExperiment",
    "NotIdentifiableError",
    "ParameterCorrelations",
    "PlannedExperiment",
    "PredictorFit",
    "Profile",
    "Recommendation",
    "ResidualTest",
    "ResultFileError",
    "StudyResults",
    "StudySpec",
    "Trend",
    "__version__",
    "agreement",
    "bootstrap",
    "channel_consistency",
    "closed_form_check",
    "compare",
    "constancy",
    "control",
    "covariances",
    "diagnose",
    "effect_cost",
    "envelope",
    "expected_std",
    "frequency_responses",
    "improve",
    "judge",
    "least_squares",
    "load",
    "model_response",
    "next_experiment",
    "output_error",
    "output_error_batch",
    "prediction_error",
    "prediction_error_nonlinear",
    "profile",
    "recommended",
    "save",
    "study",
]
