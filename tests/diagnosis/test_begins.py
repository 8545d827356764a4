"""Where the fit of a model with effects more begins, and what comes of a model that follows next to nothing."""

from typing import Any

import made_up_results
import numpy as np
import pytest
from command_line import call, refused
from made_up_loop import made

import estimators as est
import rtac_jax as rtac
from estimators.core.results import DivergedError
from estimators.diagnosis import model_extension
from estimators.diagnosis.policy import STANDARD
from rtac_jax.effects import EndStop
from rtac_jax.measurement import Recording

NOTHING: Any = made(Recording)
STATES = {"free_1": np.array([0.01, 0.0, 0.2, 0.0])}


def test_it_begins_at_the_nearest_values_with_the_states_that_go_with_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a spring with a gap right values beside starts of the first samples ended at three times the noise."""
    far, near, lost = (rtac.RTAC.paper().with_values({"spring_stiffness": k}) for k in (100.0, 132.0, 9.0))

    def compared(model: rtac.RTAC, *_: Any, **__: Any) -> est.Comparison:
        if model is lost:
            raise DivergedError("it diverges.")
        one = made_up_results.compared("model", 1.0 if model is near else 9.0)
        return est.Comparison((one.__class__(one.label, model, one.traces, STATES if model is near else {}, {}),))

    asked: list[tuple[rtac.RTAC, Any]] = []

    def output_error(model: rtac.RTAC, *_: Any, start: Any, **__: Any) -> est.Fit:
        asked.append((model, start))
        if model is near and len(asked) == 1:
            raise np.linalg.LinAlgError("Singular matrix")
        return made_up_results.FIT

    monkeypatch.setattr(model_extension, "compare", compared)
    monkeypatch.setattr(model_extension, "output_error", output_error)
    begins = model_extension._nearest_first([far, lost, near], NOTHING)
    assert [begin.model for begin in begins] == [near, far, lost]
    assert model_extension._fitted(begins, NOTHING, progress=False) is made_up_results.FIT
    assert asked == [(near, STATES), (far, {})], "where the first comes to nothing the next is tried"
    assert begins[-1].start is None


def test_a_matrix_that_is_singular_is_a_model_that_comes_to_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def singular(*_: Any, **__: Any) -> Any:
        raise np.linalg.LinAlgError("Singular matrix")

    for name in ("output_error", "prediction_error_nonlinear", "begun_by_equations"):
        monkeypatch.setattr(
            model_extension, name, singular if name != "begun_by_equations" else lambda _, model, *__: model
        )
    tested = made_up_results.compared("base", 50.0)
    said = model_extension.add_effects(
        made_up_results.FIT, tested, [EndStop(300.0, 1e-3)], "+ end_stop", NOTHING, NOTHING, deviations={}, policy=STANDARD,
        progress=False,
    )  # fmt: skip
    assert said == "Stopped: with end_stop the model could not be fitted: it follows next to nothing."


def test_the_command_line_says_what_to_do_about_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    def singular(*_: Any) -> Any:
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr(Recording, "load", staticmethod(singular))
    path = tmp_path / "rig.h5"
    path.write_text("")
    refused(call("info", path), 1, "what was asked cannot be computed (Singular matrix)", "look at what rtac info says")
