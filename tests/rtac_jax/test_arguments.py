"""Whoever gives one thing for another is told so in a sentence, and what would mend it."""

import inspect
import re
from typing import Any

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from rtac_jax.arguments import _kinds, checked_arguments
from rtac_jax.measurement import Experiment

PUBLIC = {
    f"{package.__name__}.{name}": getattr(package, name)
    for package in (est, rtac)
    for name in package.__all__
    if inspect.isfunction(getattr(package, name))
    and name != "judge"  # which has to do without JAX, and without these packages
}
OWN = {
    name: [n for n, p in inspect.signature(function).parameters.items() if _kinds(p.annotation)]
    for name, function in PUBLIC.items()
}
EXPERIMENT = Experiment.of("free", kind="free", sample_time=0.01, cart_position=0.01 * np.cos(0.1 * np.arange(99)))
RECORDING = rtac.Recording([EXPERIMENT])
MODEL = rtac.RTAC.paper()


@pytest.mark.parametrize(("function", "parameter"), [(f, p) for f, several in OWN.items() for p in several])
def test_every_public_function_refuses_what_is_none_of_its_kinds(function: str, parameter: str) -> None:
    """The others are left out or made up: this is asked before they are looked at."""
    signature = inspect.signature(PUBLIC[function])
    needed = {n: None for n, p in signature.parameters.items() if p.default is p.empty and n not in OWN[function]}
    others = {n: made(signature.parameters[n].annotation) for n in OWN[function] if n != parameter}
    with pytest.raises(TypeError, match=rf"^\w+: {parameter} is an object, and must be (an? |several of )") as refused:
        PUBLIC[function](**needed, **others, **{parameter: object()})
    assert str(refused.value).endswith(".")


def made(annotation: Any) -> Any:
    """Return something of the kind that is asked for, with nothing in it."""
    one, several = _kinds(annotation) or ((), ())
    kinds = [kind for kind in one if kind is not type(None)]
    return object.__new__(kinds[0]) if kinds else [object.__new__(several[0])]


def test_functions_that_estimate_are_among_them() -> None:
    assert {"model", "recording"} <= set(OWN["estimators.output_error"])
    assert {"fit", "recording"} <= set(OWN["estimators.diagnose"])
    assert sum(map(len, OWN.values())) > 40


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: est.output_error(RECORDING, MODEL), "model is a Recording, and must be an RTAC; it seems to stand at recording"),
        (lambda: est.output_error(MODEL, EXPERIMENT), "a Recording; make one of its experiments (rtac_jax.Recording([...]))."),
        (lambda: est.output_error(MODEL, [EXPERIMENT]), "recording is a list, and must be a Recording; make one"),
        (lambda: est.output_error(MODEL, "rig.h5"), "is a str, and must be a Recording; load it (rtac_jax.Recording.load)."),
        (lambda: est.compare("fit.h5", RECORDING), "or several of Fit, PredictorFit, RTAC; load it (estimators.load)."),
        (lambda: est.output_error(rtac.RTAC, RECORDING), "model is the class RTAC, and must be an RTAC; make one, RTAC(...)."),
        (lambda: rtac.RTAC.from_rig("rig.h5"), "RTAC.from_rig: recording is a str"),
    ],
)  # fmt: skip
def test_the_mend_is_told(call: Any, said: str) -> None:
    with pytest.raises(TypeError) as refused:
        call()
    assert said in str(refused.value)


def test_a_fit_in_place_of_a_model_has_one() -> None:
    fit = object.__new__(est.Fit)
    object.__setattr__(fit, "model", MODEL)
    with pytest.raises(TypeError, match=r"model is a Fit, and must be an RTAC; give its model \(\.model\)\."):
        est.prediction_error_nonlinear(fit, RECORDING)  # pyright: ignore[reportArgumentType]


def test_what_is_missing_or_too_much_is_said_by_python() -> None:
    with pytest.raises(TypeError, match=r"missing .* 'recording'"):
        est.output_error(MODEL)  # pyright: ignore[reportCallIssue]


def test_numbers_and_arrays_are_left_to_the_function() -> None:
    @checked_arguments
    def of(model: rtac.RTAC | None, omega: np.ndarray, several: list[rtac.RTAC] | float = 1.0) -> int:
        return 3

    assert of(None, "anything", several="else") == 3  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: MODEL.release("spring_stifness"), "no parameter is called spring_stifness"),
        (lambda: rtac.simulate(MODEL, EXPERIMENT, substeps=0), "substeps is 0; give at least 1"),
        (lambda: est.compare([], RECORDING), "there is nothing to compare"),
        (lambda: est.compare([MODEL, MODEL], RECORDING, labels=["a", "a"]), "labels are a, a: give each model one of its own"),
        (lambda: est.compare(MODEL, RECORDING, ahead=99), "ahead is 99: so many samples do not count, and free has 99"),
        (lambda: est.compare(MODEL, RECORDING, start_samples=200), "start_samples is 200"),
        (lambda: est.agreement([], RECORDING, level=5.0), "level is 5; give the level of a test, between 0 and 1"),
        (lambda: est.constancy(object.__new__(est.Fit), RECORDING, level=2.0), "level is 2; give"),
    ],
)  # fmt: skip
def test_what_has_no_meaning_is_refused(call: Any, said: str) -> None:
    with pytest.raises(ValueError, match=re.escape(said)):
        call()


@pytest.mark.slow
def test_models_without_a_difference_are_numbered() -> None:
    found = est.compare([MODEL, MODEL], RECORDING)
    assert [m.label for m in found.models] == ["base (1)", "base (2)"]
