"""Pictures of recordings and results; each function returns a figure whose title says what it shows."""

from estimators.plots._agreement import plot_agreement
from estimators.plots._bands import plot_bands
from estimators.plots._comparison import plot_comparison
from estimators.plots._confusion import plot_confusion
from estimators.plots._control import plot_batch, plot_closed_loop, plot_margins, plot_synthesis
from estimators.plots._diagnosis import plot_diagnosis
from estimators.plots._envelope import plot_effect_cost, plot_envelope, plot_responses
from estimators.plots._improvement import plot_improvement
from estimators.plots._next_experiment import plot_next_experiment
from estimators.plots._prediction_error import plot_equality, plot_innovations, plot_prediction_error
from estimators.plots._profile import plot_profile
from estimators.plots._recording import plot_recording
from estimators.plots._residuals import plot_residuals
from estimators.plots._study import plot_confusions, plot_coverage, plot_envelopes, plot_estimates, plot_pairs
from estimators.plots._table1 import plot_table_1
from estimators.plots._where import plot_where

__all__ = [
    "plot_agreement",
    "plot_bands",
    "plot_batch",
    "plot_closed_loop",
    "plot_comparison",
    "plot_confusion",
    "plot_confusions",
    "plot_coverage",
    "plot_diagnosis",
    "plot_effect_cost",
    "plot_envelope",
    "plot_envelopes",
    "plot_equality",
    "plot_estimates",
    "plot_improvement",
    "plot_innovations",
    "plot_margins",
    "plot_next_experiment",
    "plot_pairs",
    "plot_prediction_error",
    "plot_profile",
    "plot_recording",
    "plot_residuals",
    "plot_responses",
    "plot_synthesis",
    "plot_table_1",
    "plot_where",
]
