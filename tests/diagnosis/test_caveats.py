"""Caveats: what the last fit does not tell from nothing is not left standing as a finding."""

import dataclasses

import numpy as np
import pytest
from made_up_results import FIT, candidate, compared

from estimators.core.fisher_information import Information
from estimators.diagnosis import caveats
from estimators.diagnosis.caveats import doubtful, named_too_late, not_told_from_nothing, of_little_service
from estimators.diagnosis.policy import STANDARD
from rtac_jax import RTAC
from rtac_jax.effects import FlexibleMode
from rtac_jax.measurement import Experiment, Recording


def fitted(std):
    """Return a fit of a mode of 0.13 kg, as the loss in an end stop was taken for, with this deviation [kg]."""
    model = RTAC.paper() + FlexibleMode(mass=0.13, frequency=60.0, damping=0.0)
    names = tuple(name for name in model.parameters if name.startswith("flexible_mode."))
    deviations = np.array([std if name.endswith("mass") else 0.01 for name in names])
    information = Information(names, np.diag(deviations**2), np.eye(len(names)), np.ones(len(names)))
    return dataclasses.replace(FIT, model=model, information=information)


class Spread:
    """Deviations of which that of independent experiments is the largest."""

    def __init__(self, std):
        self.of = {"sandwich": {"flexible_mode.mass": 0.02}, "clustered": {"flexible_mode.mass": std}}

    def std(self, kind):
        return self.of[kind]


@pytest.mark.parametrize(("std", "clustered", "told"), [(0.11, 0.02, True), (0.01, 0.11, True), (0.01, 0.02, False)])
def test_an_effect_of_less_than_two_of_its_largest_deviations_is_doubted(std, clustered, told, monkeypatch):
    monkeypatch.setattr(caveats, "covariances", lambda *_: Spread(clustered))
    decay = Experiment.of("free", kind="free", sample_time=0.01, cart_position=np.cos(0.1 * np.arange(200)))
    found = doubtful(fitted(std), Recording([decay]), [candidate("flexible_mode", 50.0), candidate("end_stop", 40.0)])
    assert found == (("flexible_mode",) if told else ())  # the model has no end stop
    assert ("does not tell flexible_mode from nothing" in not_told_from_nothing(found)) is told


def test_what_was_too_late_is_named_in_one_clause():
    assert named_too_late(["cogging"]) == "cogging is named, and was not added before the time was over"
    assert named_too_late(["cogging", "dead_zone"]).startswith("cogging, dead_zone are named, and were not")


@pytest.mark.parametrize(("fitted", "follows"), [(8.0, True), (200.0, False)])
def test_a_held_out_error_that_rises_is_told_with_what_the_fitted_one_does(fitted: float, follows: bool) -> None:
    """A fit that followed nothing was nearer to a rest that was held out: "falls by 0 % only" had been said of a rise."""
    held_out, trained = [[compared("model", size) for size in pair] for pair in ((4.8, 11.0), (227.0, fitted))]
    said = of_little_service(*held_out, 1, STANDARD, (trained[0], trained[1]))
    assert ("was near that by chance, or this one lacks more" in said) is follows
    assert ("falls by 0 % only" in said) is not follows
