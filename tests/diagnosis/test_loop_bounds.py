"""What keeps the loop within the wishes and the time that it was given, and which estimates it hands over at its end."""

import dataclasses
import importlib
from typing import Any

import made_up_results
import numpy as np
import pytest
from made_up_loop import made, new_loop
from small_experiments import forced, free

import estimators as est
import rtac_jax as rtac
from estimators.core.deadline import Deadline
from estimators.diagnosis import improvement_loop, loop_end, loop_run, read_law
from estimators.diagnosis.evidence import Evidence, Facts
from estimators.diagnosis.improvement_loop import Loop
from estimators.diagnosis.loop_end import LoopEnd
from estimators.diagnosis.model_extension import Added
from estimators.inference.simulation_residual import SimulationResidual
from estimators.misspecification.force_formulas import Formula
from rtac_jax.measurement import Recording

PREDICTED: est.PredictorFit = made(est.PredictorFit, model=rtac.RTAC.paper())


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        ({}, True),
        ({"laws": False}, False),
        ({"candidates": [rtac.effects.CubicSpring]}, False),
        ({"most": 0}, False),
        ({"deadline": Deadline(0.0)}, False),
    ],
    ids=["by default", "no law is wanted", "of these candidates only", "no more effects", "no time"],
)
def test_a_law_comes_first_only_where_it_may_be_added(change: dict[str, Any], wanted: bool) -> None:
    assert dataclasses.replace(new_loop(), **change).wants_laws is wanted


def test_where_the_law_took_the_time_nothing_is_looked_at_again(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[bool] = []

    def diagnosed(*_: Any, laws_first: bool, **__: Any) -> est.Diagnosis:
        asked.append(laws_first)
        return dataclasses.replace(made_up_results.diagnosis("unknown"), awaits_law=laws_first)

    def with_law(loop: Loop) -> None:
        loop.deadline = Deadline(0.0)

    monkeypatch.setattr(improvement_loop, "diagnose", diagnosed)
    monkeypatch.setattr(loop_run, "with_law", with_law)
    monkeypatch.setattr(loop_run, "_add_beyond_catalogue", lambda *_: False)
    loop_run.run(new_loop())
    assert asked == [True]


@pytest.mark.parametrize(("way", "asked"), [("simulated", True), ("held", False)])
def test_no_other_law_is_fitted_by_simulation_where_a_simulation_did_not_choose(
    monkeypatch: pytest.MonkeyPatch, way: Any, asked: bool
) -> None:
    loop, law = new_loop(), made_up_results.candidate("law_cube", 90.0)
    step = dataclasses.replace(loop.last, tested=made_up_results.compared("+ law", 2.0))
    loop.steps = [((), step)]

    def run(one: Loop) -> None:
        one.added.append(made_up_results.candidate("cart_stribeck", 50.0))
        one.steps.append((("cart_stribeck",), dataclasses.replace(step, way=way)))
        one.diagnoses.append(made_up_results.diagnosis("unknown"))

    tried: list[int] = []
    monkeypatch.setattr(loop_run, "other_law", lambda *_, **__: tried.append(1))
    monkeypatch.setattr(read_law, "_text", lambda *_: "a force")
    monkeypatch.setattr(loop_run, "run", run)
    loop_run.going_on(
        loop, read_law.ReadLaw(step, law, made(Formula), (), made_up_results.curve("arm", "current", 0.01))
    )
    assert bool(tried) is asked


def at(ratio: float) -> est.Fit:
    """A fit that leaves so many times the noise."""
    noise = made_up_results.NOISE
    return dataclasses.replace(made_up_results.FIT, residual_std={c: ratio * level for c, level in noise.items()})


@pytest.mark.parametrize(
    ("ratio", "same", "current", "kept"),
    [(30.0, True, False, True), (4.0, True, False, False), (4.0, True, True, True), (30.0, False, True, False)],
    ids=["far", "near", "near, by noise of the current", "of an earlier model"],
)
def test_estimates_by_predictions_are_handed_over_of_the_last_model_that_goes_astray(
    monkeypatch: pytest.MonkeyPatch, ratio: float, same: bool, current: bool, kept: bool
) -> None:
    monkeypatch.setattr(loop_end, "_of_the_current", lambda _: current)
    loop = new_loop()
    fit = at(ratio)
    loop.steps = [((), made(Added, fit=fit, tested=None, way="simulated"))]
    end = LoopEnd(loop, led=(fit if same else at(ratio), PREDICTED))
    assert (end.by_predictions is PREDICTED) is kept
    assert LoopEnd(loop).by_predictions is None


@pytest.mark.parametrize("current", [True, False])
def test_predictions_are_asked_near_the_noise_too_where_it_is_that_of_the_current(
    monkeypatch: pytest.MonkeyPatch, current: bool
) -> None:
    loop = new_loop()
    tested = made_up_results.compared("base", 3.0)
    loop.steps = [((), Added(at(3.0), tested, "simulated"))]
    loop.diagnoses, asked = [made_up_results.diagnosis("adequate")], []
    monkeypatch.setattr(loop_end, "_of_the_current", lambda _: current)
    monkeypatch.setattr(loop_end, "prediction_error_nonlinear", lambda *_, **__: asked.append(1) or PREDICTED)
    monkeypatch.setattr(loop_end, "output_error", lambda *_, **__: at(3.0))
    monkeypatch.setattr(loop_end, "compare", lambda *_, **__: est.Comparison((tested,)))
    assert (loop_end.lead_by_predictions(loop) is PREDICTED) is current
    assert bool(asked) is current


@pytest.mark.parametrize(
    ("cause", "noise", "told"), [("shaken", 0.03, True), ("shaken", 0.0, False), ("noise", 0.03, False)]
)
def test_the_noise_of_the_current_is_what_leads_astray_where_it_explains_the_random_torque(
    cause: Any, noise: float, told: bool
) -> None:
    loop = new_loop()
    facts = made(Facts, current_noise=noise)
    found = made(SimulationResidual, cause=cause, random_force=0.0, random_torque=0.03)
    record = dataclasses.replace(
        made_up_results.diagnosis("adequate"), simulation=found, evidence=made(Evidence, facts=facts)
    )
    loop.diagnoses = [record]
    assert loop_end._of_the_current(loop) is told


@pytest.mark.parametrize(("verdict", "over"), [("adequate", 0.5), ("unknown", 1.0)])
def test_errors_of_an_adequate_model_are_held_against_the_coloured_noise(
    monkeypatch: pytest.MonkeyPatch, verdict: str, over: float
) -> None:
    """Of a model that fails, colour may stand for what is missing."""
    module = importlib.import_module("estimators.diagnosis.improve")
    colour = {c: 2 * level for c, level in made_up_results.NOISE.items()}
    told = dataclasses.replace(made_up_results.diagnosis(verdict), effects=(), additions=(), coloured=colour)
    base = est.Comparison((made_up_results.compared("base", 3.0),))

    def run(loop: Loop) -> None:
        loop.diagnoses, loop.diagnosed, loop.stopped = [told], [0], "Stopped."

    monkeypatch.setattr(module, "fit_what_shows", lambda *_, **__: (made_up_results.FIT, ()))
    monkeypatch.setattr(module, "compare", lambda *_, **__: base)
    monkeypatch.setattr(module, "compile_diagnosis", lambda *_: None)
    monkeypatch.setattr(module, "end_of", lambda loop, **_: LoopEnd(loop))
    monkeypatch.setattr(module, "run", run)
    recording = Recording((free("a"), free("b"), forced("c"), forced("d")))
    found = est.improve(rtac.RTAC.paper(), recording, progress=False)
    for comparison in (found.train, found.validation):
        for channel, error in comparison.models[0].errors.items():
            before = base.models[0].errors[channel].rms_over_noise
            assert error.rms_over_noise == pytest.approx(over * before)
    quieter = base.with_noise({c: 0.1 * level for c, level in made_up_results.NOISE.items()})
    assert quieter.models[0].errors == base.models[0].errors, "no noise becomes less"
    assert np.all([t.noise == made_up_results.NOISE[t.channel] for t in base.models[0].traces])
