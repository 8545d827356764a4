"""A loop of improvements with a model made by hand, for tests of where it goes on."""

from typing import Any

import made_up_results
import numpy as np

import estimators as est
import rtac_jax as rtac
from estimators.core.fisher_information import information_of
from estimators.core.results import RESULTS
from estimators.diagnosis.improvement_loop import Loop
from estimators.diagnosis.model_extension import Added
from estimators.diagnosis.policy import STANDARD


def made(cls: Any, **values: Any) -> Any:
    """Return a record with some of its values."""
    found = object.__new__(cls)
    values.setdefault("values", {})
    for name, value in values.items():
        object.__setattr__(found, name, value)
    return found


def added(model: rtac.RTAC) -> Added:
    known = information_of(np.eye(1), ("total_mass",), np.ones(1))
    fit = est.Fit(model, RESULTS.successful, known, {}, {}, {}, (), {})
    return made(Added, fit=fit, tested=made_up_results.compared("made", 30.0), way="simulated")


def new_loop(most: int = 4) -> Loop:
    nothing = made(rtac.Recording)
    return Loop(nothing, nothing, None, most, True, STANDARD, False, [((), added(rtac.RTAC.paper()))])
