"""Pictures of recordings and results; each function returns a figure whose title says what it shows."""

from estimators.plots._comparison import plot_comparison
from estimators.plots._diagnosis import plot_diagnosis
from estimators.plots._improvement import plot_improvement
from estimators.plots._recording import plot_recording
from estimators.plots._residuals import plot_residuals

__all__ = ["plot_comparison", "plot_diagnosis", "plot_improvement", "plot_recording", "plot_residuals"]
