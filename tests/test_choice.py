"""Which refit is chosen, and what becomes of an effect when a later one explains what it was chosen for; on made-up gains."""

import contextlib
from collections.abc import Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from estimators._candidate import Step
from estimators._choice import chosen, reconsidered
from estimators._refit import Refit
from estimators._screen import Screened
from estimators._search import Search
from rtac_jax.effects import CATALOGUE

SIZES = {"arm_stribeck": 2, "arm_coulomb": 1, "lvdt_lag": 1, "cubic_spring": 1}


class Known(Search):
    """A search in which the log-likelihood with every set of effects is known beforehand."""

    def __init__(self, likelihood: dict[frozenset[str], float], loose: Sequence[str] = ()) -> None:
        self.likelihood, self.runaways = likelihood, loose
        self.classes = dict(CATALOGUE)
        self.bar = SimpleNamespace(set_description=lambda text: None)

    @property
    def samples(self) -> int:
        return 10_000

    def refit(self, *effects: str) -> Refit:
        found = Refit.__new__(Refit)
        value = self.likelihood[frozenset(effects)]
        halves = np.array([[0.5 * value - 1.0], [0.5 * value + 1.0]])
        parts: dict[str, Any] = {
            "added": effects,
            "free": tuple(f"{e}.{n}" for e in effects for n in range(SIZES[e])),
            "predictor": SimpleNamespace(log_likelihood=value),
            "by_sample": halves,
        }
        for name, part in parts.items():
            object.__setattr__(found, name, part)
        return found

    def stretches(self) -> np.ndarray:
        return np.array([[0], [1]])

    def held_out_gain(self, before: Refit, after: Refit) -> float:
        return 1.0

    def loose(self, effect: str, refit: Refit) -> bool:
        return effect in self.runaways

    def with_effect(self, before: Refit, s: Screened) -> Refit:
        return self.refit(*before.added, s.id)

    def without(self, refit: Refit, effect: str) -> Refit:
        return self.refit(*(e for e in refit.added if e != effect))

    def tested(self, refit: Refit) -> Any:
        return SimpleNamespace(tests=())

    @contextlib.contextmanager
    def refitting(self, before: Refit, several: Sequence[Screened]) -> Iterator[Any]:
        yield lambda s: self.with_effect(before, s)


def screened(effect: str) -> Screened:
    found = Screened.__new__(Screened)
    object.__setattr__(found, "id", effect)
    return found


def known(**likelihood: float) -> dict[frozenset[str], float]:
    """Log-likelihoods by effects, whose names are joined by `__`."""
    return {frozenset(names.split("__")) - {"base"}: value for names, value in likelihood.items()}


def step(search: Known, before: Sequence[str], several: Sequence[str]) -> Step | None:
    tried = {e: (screened(e), search.refit(*before, e)) for e in several}
    return chosen(search, search.refit(*before), tried)


def steps(search: Known, *rounds: Sequence[str]) -> list[Step]:
    """What a forward selection from these candidates finds."""
    found: list[Step] = []
    for several in rounds:
        one = step(search, found[-1].refit.added if found else (), several)
        assert one is not None
        found.append(one)
    return found


@pytest.mark.parametrize(
    ("stribeck", "rivals"),
    [
        (1003.0, ()),  # what the spare parameter gains comes by chance
        (1004.0, ("arm_stribeck",)),  # more than by chance in one of a hundred, less than BIC asks
    ],
)
def test_an_effect_is_no_rival_of_the_simpler_one_that_it_contains(stribeck: float, rivals: tuple[str, ...]) -> None:
    search = Known(known(base=0.0, arm_coulomb=1000.0, arm_stribeck=stribeck))
    found = step(search, (), ["arm_stribeck", "arm_coulomb"])
    assert found is not None
    assert (found.id, found.rivals) == ("arm_coulomb", rivals)


def test_a_shape_that_ran_away_is_chosen_only_where_nothing_else_helps() -> None:
    likelihood = known(base=0.0, arm_coulomb=900.0, arm_stribeck=1000.0, cubic_spring=1.0)
    for others, expected in ((["arm_coulomb"], "arm_coulomb"), (["cubic_spring"], "arm_stribeck")):
        found = step(Known(likelihood, loose=["arm_stribeck"]), (), ["arm_stribeck", *others])
        assert found is not None
        assert found.id == expected
    assert step(Known(likelihood), (), ["cubic_spring"]) is None


def test_an_effect_gives_way_to_the_one_that_it_stood_for() -> None:
    """Stribeck friction mends a part of what the lag does, until the lag is in the model."""
    search = Known(
        known(
            base=0.0, arm_stribeck=500.0, arm_coulomb=450.0, lvdt_lag=300.0, arm_stribeck__lvdt_lag=900.0,
            arm_coulomb__lvdt_lag=1000.0,
        )
    )  # fmt: skip
    before = steps(search, ["arm_stribeck", "arm_coulomb"], ["lvdt_lag"])
    assert [s.id for s in before] == ["arm_stribeck", "lvdt_lag"]
    after = reconsidered(search, search.refit(), before)
    assert [s.id for s in after] == ["lvdt_lag", "arm_coulomb"]
    assert [s.gain for s in after] == pytest.approx([600.0, 1400.0])
    assert after[-1].refit.added == ("lvdt_lag", "arm_coulomb")


def test_an_effect_that_is_not_needed_any_more_goes() -> None:
    search = Known(known(base=0.0, arm_coulomb=100.0, lvdt_lag=898.0, arm_coulomb__lvdt_lag=900.0))
    after = reconsidered(search, search.refit(), steps(search, ["arm_coulomb"], ["lvdt_lag"]))
    assert [(s.id, s.gain) for s in after] == [("lvdt_lag", pytest.approx(1796.0))]


def test_what_is_needed_stays_and_a_rival_of_the_first_round_is_told_from_it() -> None:
    likelihood = known(base=0.0, cubic_spring=500.0, arm_coulomb=498.0, lvdt_lag=300.0)
    likelihood |= known(cubic_spring__lvdt_lag=1000.0, arm_coulomb__lvdt_lag=600.0)
    search = Known(likelihood)
    before = steps(search, ["cubic_spring", "arm_coulomb"], ["lvdt_lag"])
    assert before[0].rivals == ("arm_coulomb",)
    after = reconsidered(search, search.refit(), before)
    assert [s.id for s in after] == ["cubic_spring", "lvdt_lag"]
    assert after[0].rivals == ()
