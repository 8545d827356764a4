"""A search whose log-likelihoods are known beforehand, for tests of what is made of them."""

from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from estimators.core.compilation import Ahead
from estimators.diagnosis.refit import Refit
from estimators.diagnosis.refit import Tested as Answers
from estimators.diagnosis.refitting import Search
from estimators.misspecification.candidate_screening import Screened
from rtac_jax.effects import CATALOGUE

SIZES = {"arm_stribeck": 2, "arm_coulomb": 1, "lvdt_lag": 1, "cubic_spring": 1}


class Known(Search):
    """A search in which the log-likelihood with every set of effects is known beforehand."""

    def __init__(
        self,
        likelihood: dict[frozenset[str], float],
        loose: Sequence[str] = (),
        held_out: Mapping[str, float] | None = None,
    ) -> None:
        self.likelihood, self.runaways, self.held_out = likelihood, loose, held_out or {}
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
        (effect,) = set(after.added) - set(before.added)
        return self.held_out.get(effect, 1.0)

    def loose(self, effect: str, refit: Refit) -> bool:
        return effect in self.runaways

    def with_effect(self, before: Refit, s: Screened) -> Refit:
        return self.refit(*before.added, s.id)

    def without(self, refit: Refit, effect: str) -> Refit:
        return self.refit(*(e for e in refit.added if e != effect))

    def tested(self, refit: Refit, ahead: Ahead | None = None) -> Any:
        return Answers((), (), ())

    def pieces_of_tests(self, added: Sequence[str] = (), free: Sequence[str] | None = None) -> list[Any]:
        return []

    def _extended(self, before: Refit, s: Screened) -> Any:
        return None, (), (*before.added, s.id)


def screened(effect: str) -> Screened:
    found = Screened.__new__(Screened)
    object.__setattr__(found, "id", effect)
    return found


def known(**likelihood: float) -> dict[frozenset[str], float]:
    """Log-likelihoods by effects, whose names are joined by `__`."""
    return {frozenset(names.split("__")) - {"base"}: value for names, value in likelihood.items()}
