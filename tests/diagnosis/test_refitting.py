"""Of the ways to refit a candidate thoroughly, the likelier counts, and what diverges is left out; on made-up likelihoods."""

import threading
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from estimators.core.results import DivergedError
from estimators.diagnosis import refitting
from estimators.diagnosis.refit import Refit
from estimators.diagnosis.refit import Tested as Answers
from estimators.diagnosis.refitting import refit_each, refit_first, refit_thoroughly
from estimators.diagnosis.setting import Setting
from estimators.diagnosis.workers import Workers
from estimators.misspecification.candidate_screening import Screened
from estimators.misspecification.findings import Findings
from rtac_jax import RTAC
from rtac_jax.effects import CATALOGUE, CubicSpring


@pytest.fixture
def setting() -> Setting:
    found = Setting.__new__(Setting)
    found.model, found.recording = RTAC.paper(), None  # type: ignore[assignment]
    found.classes = dict(CATALOGUE)
    found.progress = SimpleNamespace(at=lambda text: None)
    return found


def refit_of(*effects: str, likelihood: float = 0.0, size: float = 0.0) -> Refit:
    found = Refit.__new__(Refit)
    parts = {
        "added": effects,
        "free": effects,
        "predictor": SimpleNamespace(log_likelihood=likelihood, physical=(np.array([size]),)),
        "space": SimpleNamespace(names=("cubic_spring.stiffness",)),
    }
    for name, part in parts.items():
        object.__setattr__(found, name, part)
    return found


def screened(effect: str) -> Screened:
    found = Screened.__new__(Screened)
    object.__setattr__(found, "id", effect)
    return found


@pytest.fixture
def simulated(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """The filter finds a local optimum at size 2, and the refit from a simulation ends at ten times its size."""

    def begins(setting: Setting, *_: Any) -> Any:
        return setting.model + CubicSpring(1.0), ("cubic_spring.stiffness",), ("cubic_spring",)

    def ends(setting: Setting, before: Refit, added: Any, model: RTAC, free: Any, found: Any) -> Refit:
        return refit_of("cubic_spring", likelihood=20.0, size=10.0 * found.size)

    monkeypatch.setattr(refitting, "beginning", begins)
    monkeypatch.setattr(refitting, "refit_with", lambda *_: refit_of("cubic_spring", likelihood=10.0, size=2.0))
    monkeypatch.setattr(refitting, "from_simulation", ends)
    return monkeypatch


def diverges(*_: Any) -> Any:
    raise FloatingPointError("it diverges.")


def simulations(monkeypatch: pytest.MonkeyPatch, costs: dict[float, float]) -> None:
    """Fits of a simulation that stay at the size where they begin; from other sizes than these they diverge."""

    def fitted(model: RTAC, *_: Any, **__: Any) -> Any:
        size = float(np.asarray(model["cubic_spring.stiffness"]))
        if size not in costs:
            raise DivergedError("it diverges.")
        return SimpleNamespace(size=size, statistics={"cost": costs[size]})

    monkeypatch.setattr(refitting, "output_error", fitted)


def size_of(refit: Refit) -> float:
    return refit.values["cubic_spring.stiffness"]


@pytest.mark.parametrize(
    ("costs", "found"), [({1.0: 5.0, 2.0: 9.0}, 10.0), ({1.0: 9.0, 2.0: 5.0}, 20.0), ({2.0: 5.0}, 20.0), ({}, 2.0)]
)
def test_a_thorough_refit_begins_where_a_simulation_follows_best(
    setting: Setting, simulated: pytest.MonkeyPatch, costs: dict[float, float], found: float
) -> None:
    """From the fit that is diagnosed, from what the filter found, or not at all."""
    simulations(simulated, costs)
    assert size_of(refit_thoroughly(setting, refit_of(), screened("cubic_spring"))) == found


def test_a_thorough_refit_needs_the_filter_or_a_simulation(setting: Setting, simulated: pytest.MonkeyPatch) -> None:
    simulated.setattr(refitting, "refit_with", diverges)
    simulations(simulated, {})
    with pytest.raises(FloatingPointError, match="cubic_spring the model diverges"):
        refit_thoroughly(setting, refit_of(), screened("cubic_spring"))
    simulations(simulated, {1.0: 5.0})
    assert size_of(refit_thoroughly(setting, refit_of(), screened("cubic_spring"))) == 10.0


def contact(monkeypatch: pytest.MonkeyPatch, along: float | None, by_trial: float | None) -> None:
    """A candidate works by contact, and the refits along derivatives and by trial are known or diverge."""
    for name, value in (("refit_with", along), ("refit_by_trial", by_trial)):
        refit = None if value is None else refit_of("backlash", likelihood=value)
        monkeypatch.setattr(refitting, name, diverges if refit is None else lambda *_, refit=refit: refit)


@pytest.mark.parametrize(
    ("along", "by_trial", "likeliest"), [(10.0, 20.0, 20.0), (20.0, 10.0, 20.0), (None, 5.0, 5.0), (5.0, None, 5.0)]
)
def test_the_likelier_refit_of_a_contact_counts(
    setting: Setting, monkeypatch: pytest.MonkeyPatch, along: float | None, by_trial: float | None, likeliest: float
) -> None:
    contact(monkeypatch, along, by_trial)
    found = refit_thoroughly(setting, refit_of(), screened("backlash"))
    assert found.predictor.log_likelihood == likeliest


def test_a_contact_with_which_every_refit_diverges_is_refused(
    setting: Setting, monkeypatch: pytest.MonkeyPatch
) -> None:
    contact(monkeypatch, None, None)
    with pytest.raises(FloatingPointError, match="with backlash the model diverges"):
        refit_thoroughly(setting, refit_of(), screened("backlash"))


@pytest.mark.parametrize(
    ("diverging", "left"),
    [
        ((), ["cubic_spring", "lvdt_lag", "arm_coulomb", "arm_stribeck"]),
        (("arm_coulomb",), ["cubic_spring", "lvdt_lag", "arm_stribeck"]),
        (("cubic_spring",), ["lvdt_lag", "arm_coulomb", "arm_stribeck"]),
    ],
)
def test_first_refits_are_those_that_do_not_diverge_in_the_order_asked(
    setting: Setting, monkeypatch: pytest.MonkeyPatch, diverging: Any, left: list[str]
) -> None:
    """The first is tested only when another refit has begun."""
    asked: list[str] = []
    other = threading.Event()

    def fitted(setting: Setting, before: Refit, s: Screened) -> Refit:
        asked.append(s.id)
        if s.id != "cubic_spring":
            other.set()
        if s.id in diverging:
            raise DivergedError("it diverges.")
        return refit_of(*before.added, s.id)

    def tested(*_: Any) -> Answers:
        assert other.wait(timeout=60)
        return Answers((), (), Findings())

    monkeypatch.setattr(refitting, "refit_with", fitted)
    monkeypatch.setattr(refitting, "run_tests", tested)
    monkeypatch.setattr(refitting, "pieces_of_tests", lambda *_: [])
    monkeypatch.setattr(refitting, "_extended", lambda setting, before, s: (None, (), (*before.added, s.id)))
    near = [screened(effect) for effect in ("lvdt_lag", "arm_coulomb", "arm_stribeck")]
    first = screened("cubic_spring")
    found, answers = refit_first(setting, refit_of(), first, near, "filter", Workers())
    assert [(effect, refit.added) for effect, refit in found.items()] == [(effect, (effect,)) for effect in left]
    assert sorted(asked) == sorted(s.id for s in (first, *near))
    assert (answers is None) == ("cubic_spring" in diverging)
    each = refit_each(setting, refit_of(), near, "filter", Workers())
    assert list(each) == [effect for effect in left if effect != "cubic_spring"]
