"""What can be learned from a recording."""

from estimators._compare import Comparison, compare
from estimators._diagnose import Candidate, Diagnosis, diagnose
from estimators._improve import Improvement, improve
from estimators._least_squares import ClosedForm, least_squares
from estimators._output_error import Fit, output_error
from estimators._results import RESULTS, DivergedError, NotIdentifiableError

__all__ = [
    "RESULTS",
    "Candidate",
    "ClosedForm",
    "Comparison",
    "Diagnosis",
    "DivergedError",
    "Fit",
    "Improvement",
    "NotIdentifiableError",
    "compare",
    "diagnose",
    "improve",
    "least_squares",
    "output_error",
]
