"""A fitted predictor with some of the candidates added, and the tests of its innovations."""

import dataclasses

import numpy as np

from estimators.core.parameter_space import Space
from estimators.core.residual import start_rows
from estimators.misspecification.candidate_screening import Screened
from estimators.misspecification.findings import Findings
from estimators.misspecification.static_force import ForceCurve
from estimators.prediction_error.noise_estimation import Predictor
from rtac_jax import RTAC


@dataclasses.dataclass(frozen=True)
class Refit:
    """A model with some of the candidates added, fitted to the data.

    Attributes:
        added: ids of the effects beyond the base model.
        model: with them.
        predictor: the fit.
        space: its unknowns.
        by_sample: log-likelihood of each sample.
        free: names of the free parameters.
        triangles: triangular factors of the innovations and their derivatives, for each experiment.
    """

    added: tuple[str, ...]
    model: RTAC
    predictor: Predictor
    space: Space
    by_sample: np.ndarray
    free: tuple[str, ...]
    triangles: np.ndarray

    @property
    def values(self) -> dict[str, float]:
        """Return all shared parameters by name."""
        return dict(zip(self.space.names, np.asarray(self.predictor.physical[0]).tolist(), strict=True))

    @property
    def start(self) -> dict[str, np.ndarray]:
        """States at the start by name, of every experiment."""
        return dict(zip(start_rows(self.model), np.asarray(self.predictor.physical[2]), strict=True))


@dataclasses.dataclass(frozen=True)
class Tested:
    """The tests of the innovations of one model.

    Attributes:
        screened: named candidates, every shape of them.
        curves: missing force against each variable.
        findings: all that was computed, without any verdict.
    """

    screened: tuple[Screened, ...]
    curves: tuple[ForceCurve, ...]
    findings: Findings

    def without_templates(self) -> "Tested":
        """Return the tests without the templates of candidates, of which detection limits and correlations are made."""
        return dataclasses.replace(self, screened=tuple(s.without_templates() for s in self.screened))
