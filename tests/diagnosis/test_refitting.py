"""Of the ways to refit a candidate thoroughly, the likelier counts; on made-up likelihoods."""

import threading
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from known_search import known

from estimators.core.compilation import Ahead
from estimators.core.results import DivergedError
from estimators.diagnosis import refitting
from estimators.diagnosis.refit import Refit
from estimators.diagnosis.refit import Tested as Answers
from estimators.diagnosis.refitting import Search
from estimators.misspecification.candidate_screening import Screened
from estimators.misspecification.findings import Findings
from rtac_jax import RTAC
from rtac_jax.effects import CATALOGUE, Backlash, CubicSpring


class Known(Search):
    """A search in which the log-likelihood with every set of effects is known beforehand."""

    def __init__(self, likelihood: dict[frozenset[str], float]) -> None:
        self.likelihood = likelihood
        self.classes = dict(CATALOGUE)
        self.bar = SimpleNamespace(set_description=lambda text: None)

    def refit(self, *effects: str) -> Refit:
        found = Refit.__new__(Refit)
        parts = {
            "added": effects,
            "free": effects,
            "predictor": SimpleNamespace(log_likelihood=self.likelihood[frozenset(effects)]),
        }
        for name, part in parts.items():
            object.__setattr__(found, name, part)
        return found

    def with_effect(self, before: Refit, s: Screened) -> Refit:
        return self.refit(*before.added, s.id)

    def tested(self, refit: Refit, ahead: Ahead | None = None) -> Any:
        return Answers((), (), Findings())

    def pieces_of_tests(self, added: Sequence[str] = (), free: Sequence[str] | None = None) -> list[Any]:
        return []

    def _extended(self, before: Refit, s: Screened) -> Any:
        return None, (), (*before.added, s.id)


def screened(effect: str) -> Screened:
    found = Screened.__new__(Screened)
    object.__setattr__(found, "id", effect)
    return found


class Simulated(Known):
    """One in which the filter finds a local optimum at size 2, and the refit from a simulation ends at ten times its size."""

    filter_follows = True
    model = RTAC.paper()
    recording: Any = None

    def _beginning(self, before: Refit, s: Screened) -> Any:
        return self.model + CubicSpring(1.0), (), ("cubic_spring",)

    def _at(self, likelihood: float, size: float) -> Refit:
        found = self.refit()
        predictor = SimpleNamespace(log_likelihood=likelihood, physical=(np.array([size]),))
        object.__setattr__(found, "predictor", predictor)
        object.__setattr__(found, "space", SimpleNamespace(names=("cubic_spring.stiffness",)))
        return found

    def with_effect(self, before: Refit, s: Screened) -> Refit:
        if not self.filter_follows:
            raise FloatingPointError
        return self._at(10.0, 2.0)

    def _from_simulation(self, before: Refit, added: Any, model: RTAC, free: Any, found: Any) -> Refit:
        return self._at(20.0, 10.0 * found.size)


def simulations(monkeypatch: pytest.MonkeyPatch, costs: dict[float, float]) -> None:
    """Fits of a simulation that stay at the size where they begin; from other sizes than these they diverge."""

    def fitted(model: RTAC, *_: Any, **__: Any) -> Any:
        size = float(np.asarray(model["cubic_spring.stiffness"]))
        if size not in costs:
            raise DivergedError("it diverges.")
        return SimpleNamespace(size=size, statistics={"cost": costs[size]})

    monkeypatch.setattr(refitting, "output_error", fitted)


@pytest.mark.parametrize(
    ("costs", "found"), [({1.0: 5.0, 2.0: 9.0}, 10.0), ({1.0: 9.0, 2.0: 5.0}, 20.0), ({2.0: 5.0}, 20.0), ({}, 2.0)]
)
def test_a_thorough_refit_begins_where_a_simulation_follows_best(
    monkeypatch: pytest.MonkeyPatch, costs: dict[float, float], found: float
) -> None:
    """From the fit that is diagnosed, from what the filter found, or not at all."""
    simulations(monkeypatch, costs)
    search = Simulated(known(base=0.0))
    assert search.thoroughly(search.refit(), screened("cubic_spring")).values["cubic_spring.stiffness"] == found


def test_a_thorough_refit_needs_the_filter_or_a_simulation(monkeypatch: pytest.MonkeyPatch) -> None:
    search = Simulated(known(base=0.0))
    search.filter_follows = False
    simulations(monkeypatch, {})
    with pytest.raises(FloatingPointError, match="cubic_spring the model diverges"):
        search.thoroughly(search.refit(), screened("cubic_spring"))
    simulations(monkeypatch, {1.0: 5.0})
    assert search.thoroughly(search.refit(), screened("cubic_spring")).values["cubic_spring.stiffness"] == 10.0


class Contact(Known):
    """One in which a candidate works by contact, and the refits along derivatives and by trial are known or diverge."""

    def __init__(self, along: float | None, by_trial: float | None) -> None:
        super().__init__(known(base=0.0))
        self.classes = {"backlash": Backlash}
        self.found = along, by_trial

    def _refit(self, likelihood: float | None) -> Refit:
        if likelihood is None:
            raise DivergedError("it diverges.")
        found = self.refit()
        object.__setattr__(found, "predictor", SimpleNamespace(log_likelihood=likelihood))
        return found

    def with_effect(self, before: Refit, s: Screened) -> Refit:
        return self._refit(self.found[0])

    def by_trial(self, before: Refit, s: Screened) -> Refit:
        return self._refit(self.found[1])


@pytest.mark.parametrize(
    ("along", "by_trial", "likeliest"), [(10.0, 20.0, 20.0), (20.0, 10.0, 20.0), (None, 5.0, 5.0), (5.0, None, 5.0)]
)
def test_the_likelier_refit_of_a_contact_counts(along: float | None, by_trial: float | None, likeliest: float) -> None:
    search = Contact(along, by_trial)
    assert search.thoroughly(search.refit(), screened("backlash")).predictor.log_likelihood == likeliest


def test_a_contact_with_which_every_refit_diverges_is_refused() -> None:
    search = Contact(None, None)
    with pytest.raises(FloatingPointError, match="with backlash the model diverges"):
        search.thoroughly(search.refit(), screened("backlash"))


class Refused(Known):
    """One in which the model diverges with some candidates, and the first is tested only when another refit has begun."""

    diverging: tuple[str, ...] = ()

    def __init__(self, likelihood: dict[frozenset[str], float]) -> None:
        super().__init__(likelihood)
        self.asked: list[str] = []
        self.other = threading.Event()

    def with_effect(self, before: Refit, s: Screened) -> Refit:
        self.asked.append(s.id)
        if s.id != "cubic_spring":
            self.other.set()
        if s.id in self.diverging:
            raise DivergedError("it diverges.")
        return super().with_effect(before, s)

    def tested(self, refit: Refit, ahead: Ahead | None = None) -> Any:
        assert self.other.wait(timeout=60)
        return super().tested(refit, ahead)


@pytest.mark.parametrize(
    ("diverging", "left"),
    [
        ((), ["cubic_spring", "lvdt_lag", "arm_coulomb", "arm_stribeck"]),
        (("arm_coulomb",), ["cubic_spring", "lvdt_lag", "arm_stribeck"]),
        (("cubic_spring",), ["lvdt_lag", "arm_coulomb", "arm_stribeck"]),
    ],
)
def test_first_refits_are_those_that_do_not_diverge_in_the_order_asked(diverging: Any, left: list[str]) -> None:
    search = Refused(known(base=0.0, cubic_spring=4.0, lvdt_lag=3.0, arm_coulomb=2.0, arm_stribeck=1.0))
    search.diverging = diverging
    near = [screened(effect) for effect in ("lvdt_lag", "arm_coulomb", "arm_stribeck")]
    found, tested = search.first_refits(search.refit(), screened("cubic_spring"), near)
    assert [(effect, refit.added) for effect, refit in found.items()] == [(effect, (effect,)) for effect in left]
    assert sorted(search.asked) == sorted(s.id for s in (screened("cubic_spring"), *near))
    assert (tested is None) == ("cubic_spring" in diverging)
    assert list(search.refits(search.refit(), near)) == [effect for effect in left if effect != "cubic_spring"]
