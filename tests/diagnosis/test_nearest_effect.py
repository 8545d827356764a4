"""The nearest effect as a last resort: where it explains most of what is missing and serves held-out experiments better."""

import dataclasses

import numpy as np
import pytest
from made_up_results import OTHERS, compared, diagnosis, improvement
from small_experiments import forced

import estimators as est
import rtac_jax as rtac
from estimators.core.fisher_information import Information
from estimators.core.fit import Parameter
from estimators.diagnosis import nearest_effect
from estimators.diagnosis.model_extension import Added
from estimators.diagnosis.nearest_effect import nearest_of
from rtac_jax.effects import CATALOGUE, CubicSpring, Effect
from rtac_jax.parameters import declarations

RECORDING = rtac.Recording((forced(),), {"total_mass": 1.23, "arm_inertia": 9.5e-5})
MODEL = rtac.RTAC.paper()
FREE = len(MODEL.free)
FIT = est.Fit(
    MODEL, est.RESULTS.successful, Information(MODEL.free, np.eye(FREE), np.eye(FREE), np.ones(FREE)),
    {"cart_position": 1e-5}, {"cart_position": 1e-5}, {}, ("forced",), {"agreed": 1, "starts": 1},
)  # fmt: skip


def candidate(**changes: object) -> est.Candidate:
    told = {"id": "cubic_spring", "testable": True, "refitted": True, "bic_gain": 50.0, "error_reduction": 0.8}
    told["parameters"] = {"stiffness": Parameter(7e4, 1e3, "N/m^3")}
    return dataclasses.replace(OTHERS[0], **(told | changes))


def of_any_size(effect: type[Effect]) -> dict[str, Parameter]:
    return {name: Parameter(1e-2, 1e-4, "1") for name in declarations(effect)}


def unknown(*candidates: est.Candidate) -> est.Diagnosis:
    return dataclasses.replace(diagnosis("unknown"), candidates=candidates, additions=())


@pytest.mark.parametrize(
    ("error", "deviation", "kept"), [(20.0, 1e3, False), (10.0, 1e3, True), (10.0, 1e5, False), (None, 1e3, False)]
)
def test_one_that_does_not_help_is_not_added(
    error: float | None, deviation: float, kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a fit with it leaves of held-out experiments, 20 times the noise without it; or why there is no fit.

    One whose size is less than its deviation may as well not be there, whatever the experiments say.
    """
    before = Added(FIT, compared("base", 20.0), "simulated")
    model = MODEL + CubicSpring(7e4)
    spread = np.where(np.array(model.free) == "cubic_spring.stiffness", deviation, 1.0) ** 2
    known = Information(model.free, np.diag(spread), np.eye(len(spread)), np.ones(len(spread)))
    with_it = dataclasses.replace(FIT, model=model, information=known)
    after = "Stopped." if error is None else Added(with_it, compared("+ cubic_spring", error), "simulated")
    monkeypatch.setattr(nearest_effect, "add_effects", lambda *_, **__: after)
    found = nearest_effect.add_nearest(
        before, unknown(candidate()), {"cubic_spring": CubicSpring}, RECORDING, RECORDING, progress=False
    )
    assert (found is not None) is kept


@pytest.mark.parametrize("changes", [{"error_reduction": 0.4}, {"refitted": False}, {"bic_gain": -1.0}])
def test_what_explains_less_than_half_or_could_not_be_fitted_is_none(changes: dict[str, object]) -> None:
    assert nearest_of(unknown(candidate(**changes))) == ()
    (chosen,) = nearest_of(unknown(candidate(**changes), candidate(id="other", error_reduction=0.6)))
    assert chosen.id == "other"


def test_what_simulations_speak_for_is_asked_where_predictions_miss_nothing() -> None:
    simulated = candidate(id="arm_coulomb", refitted=False, error_reduction=0.7)
    found = dataclasses.replace(unknown(candidate()), nearest_simulated=(simulated,))
    assert nearest_of(found) == (simulated, candidate())
    assert nearest_of(dataclasses.replace(found, candidates=())) == (simulated,)


def test_the_picture_and_the_bullets_call_it_likely() -> None:
    found = dataclasses.replace(
        improvement(2), diagnoses=(unknown(),), verdict="unknown", added=(), nearest=candidate()
    )
    labels = [text.get_text() for text in found.plot().axes[0].get_xticklabels()]
    assert labels[-1] == "+ cubic_spring, likely"


def test_of_several_that_simulations_speak_for_held_out_experiments_choose(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first takes most off what was fitted, and leaves the held-out experiments worse; none is taken that does not serve."""
    left = {"dead_zone": 70.0, "arm_coulomb": 36.0, "arm_stribeck": 38.0}
    several = tuple(candidate(id=name, parameters=of_any_size(CATALOGUE[name])) for name in left)
    found = dataclasses.replace(unknown(), candidates=(), nearest_simulated=several)
    before = Added(FIT, compared("base", 63.0), "simulated")

    def tried(last: object, tested: object, effects: list[Effect], *_: object, **__: object) -> Added:
        return Added(FIT, compared("with it", left[effects[0].id]), "simulated")

    monkeypatch.setattr(nearest_effect, "add_effects", tried)
    monkeypatch.setattr(nearest_effect, "is_sure", lambda *_: True)
    taken = nearest_effect.add_nearest(before, found, CATALOGUE, RECORDING, RECORDING, progress=False)
    assert taken is not None
    assert taken[1].id == "arm_coulomb"
    left.update(arm_coulomb=62.0, arm_stribeck=64.0)
    assert nearest_effect.add_nearest(before, found, CATALOGUE, RECORDING, RECORDING, progress=False) is None
