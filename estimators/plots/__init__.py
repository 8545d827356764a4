"""Pictures of recordings and results; each function returns a figure whose title says what it shows."""

import functools

from estimators.closed_form.table1 import ClosedForm
from estimators.controller.outcome import ControlDesign
from estimators.core.parameter_correlation import ParameterCorrelations
from estimators.diagnosis.diagnosis import Diagnosis
from estimators.diagnosis.improvement import Improvement
from estimators.experiment_design.next_experiment import NextExperiment
from estimators.frequency_response.response import FrequencyResponses
from estimators.inference.agreement import Agreement
from estimators.inference.profile_likelihood import Profile
from estimators.linear.fit import LinearModels
from estimators.linear.homogeneity_test import Equality
from estimators.plots.agreement import plot_agreement
from estimators.plots.bands import plot_bands
from estimators.plots.bode import plot_bode
from estimators.plots.comparison import plot_comparison
from estimators.plots.confusion import plot_confusion
from estimators.plots.control import plot_batch, plot_closed_loop, plot_margins, plot_synthesis
from estimators.plots.diagnosis import plot_diagnosis
from estimators.plots.envelope import plot_effect_cost, plot_envelope, plot_responses
from estimators.plots.improvement import plot_improvement
from estimators.plots.learned_force import plot_learned_force
from estimators.plots.next_experiment import plot_next_experiment
from estimators.plots.parameter_correlation import plot_correlations
from estimators.plots.pole_zero import plot_poles_zeros
from estimators.plots.prediction_error import plot_equality, plot_innovations, plot_prediction_error
from estimators.plots.profile import plot_profile
from estimators.plots.recording import plot_recording
from estimators.plots.residuals import plot_residuals
from estimators.plots.study import plot_confusions, plot_coverage, plot_envelopes, plot_estimates, plot_pairs
from estimators.plots.study_bode import plot_bode_bands
from estimators.plots.style import Picture
from estimators.plots.table1 import plot_table_1
from estimators.plots.where import plot_where
from estimators.prediction_error.fit import PredictorFit
from estimators.study.results import StudyResults
from estimators.uncertainty.effect_cost import EffectCost
from estimators.uncertainty.envelope import Envelope
from estimators.validation.simulation_error import Comparison


@functools.singledispatch
def draw(result: object, *arguments: object) -> Picture:
    """Draw the picture that belongs to a result; each type of result registers its own below.

    Raises:
        TypeError: no picture is registered for results of this type.
    """
    raise TypeError(
        f"there is no picture of a {type(result).__name__}; the functions of estimators.plots draw what there is."
    )


for _type, _picture in {
    Agreement: plot_agreement,
    ClosedForm: plot_table_1,
    Comparison: plot_comparison,
    Diagnosis: plot_diagnosis,
    EffectCost: plot_effect_cost,
    Envelope: plot_envelope,
    Equality: plot_equality,
    FrequencyResponses: plot_responses,
    Improvement: plot_improvement,
    LinearModels: plot_prediction_error,
    NextExperiment: plot_next_experiment,
    ParameterCorrelations: plot_correlations,
    PredictorFit: plot_innovations,
    Profile: plot_profile,
}.items():
    draw.register(_type, _picture)


@draw.register
def _(result: ControlDesign) -> Picture:
    return plot_closed_loop(result.free, {"closed loop": result.closed})


@draw.register
def _(result: StudyResults, which: str) -> Picture:
    # The names by which a study captions its pictures.
    return {
        "estimates": plot_estimates,
        "coverage": plot_coverage,
        "pairs": plot_pairs,
        "confusion": plot_confusions,
        "envelopes": plot_envelopes,
        "bode": plot_bode_bands,
    }[which](result)


__all__ = [
    "draw",
    "plot_agreement",
    "plot_bands",
    "plot_batch",
    "plot_bode",
    "plot_bode_bands",
    "plot_closed_loop",
    "plot_comparison",
    "plot_confusion",
    "plot_confusions",
    "plot_correlations",
    "plot_coverage",
    "plot_diagnosis",
    "plot_effect_cost",
    "plot_envelope",
    "plot_envelopes",
    "plot_equality",
    "plot_estimates",
    "plot_improvement",
    "plot_innovations",
    "plot_learned_force",
    "plot_margins",
    "plot_next_experiment",
    "plot_pairs",
    "plot_poles_zeros",
    "plot_prediction_error",
    "plot_profile",
    "plot_recording",
    "plot_residuals",
    "plot_responses",
    "plot_synthesis",
    "plot_table_1",
    "plot_where",
]
