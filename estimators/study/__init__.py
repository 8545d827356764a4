"""Monte Carlo studies: repeat drawing, recording and estimating, and see whether what is stated is true."""

from estimators.study.bootstrap import Bootstrap, bootstrap
from estimators.study.declarative import SpecError, Values
from estimators.study.results import StudyResults
from estimators.study.run import WorkerError, study
from estimators.study.spec import Estimate, Excitation, Fitted, Hidden, Noise, Plant, StudySpec
from estimators.study.storage import StorageError

__all__ = [
    "Bootstrap",
    "Estimate",
    "Excitation",
    "Fitted",
    "Hidden",
    "Noise",
    "Plant",
    "SpecError",
    "StorageError",
    "StudyResults",
    "StudySpec",
    "Values",
    "WorkerError",
    "bootstrap",
    "study",
]
