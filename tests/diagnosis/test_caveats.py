"""Caveats: what the last fit does not tell from nothing is not left standing as a finding."""

import numpy as np
import pytest
from made_up_results import FIT, candidate

from estimators.core.fisher_information import Information
from estimators.diagnosis.caveats import named_too_late, not_told_from_nothing
from rtac_jax import RTAC
from rtac_jax.effects import FlexibleMode


def fitted(std):
    """Return a fit of a mode of 0.13 kg, as the loss in an end stop was taken for, with this deviation [kg]."""
    import dataclasses

    model = RTAC.paper() + FlexibleMode(mass=0.13, frequency=60.0, damping=0.0)
    names = tuple(name for name in model.parameters if name.startswith("flexible_mode."))
    deviations = np.array([std if name.endswith("mass") else 0.01 for name in names])
    information = Information(names, np.diag(deviations**2), np.eye(len(names)), np.ones(len(names)))
    return dataclasses.replace(FIT, model=model, information=information)


@pytest.mark.parametrize(("std", "told"), [(0.11, True), (0.01, False)])
def test_an_effect_of_less_than_two_deviations_is_doubted(std, told):
    said = not_told_from_nothing(fitted(std), [candidate("flexible_mode", 50.0), candidate("end_stop", 40.0)])
    assert ("does not tell flexible_mode from nothing" in said) is told
    assert "end_stop" not in said  # which the model has not


def test_what_was_too_late_is_named_in_one_clause():
    assert named_too_late(["cogging"]) == "cogging is named, and was not added before the time was over"
    assert named_too_late(["cogging", "dead_zone"]).startswith("cogging, dead_zone are named, and were not")
