"""What the loop asks of an effect before it is kept, and what it does with parameters that the base model could not show."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import made_up_results
import numpy as np
import pytest
from made_up_loop import new_loop
from made_up_results import FIT

import estimators as est
import rtac_jax as rtac
from estimators.core.fisher_information import information_of
from estimators.diagnosis import improvement_loop
from estimators.diagnosis.improvement_loop import Loop
from estimators.diagnosis.model_extension import Added

COMPARED = made_up_results.compared("+ cubic_spring", 2.0)


def with_spring(std: float, fixed: tuple[str, ...] = ()) -> est.Fit:
    """A fit that knows a cubic spring of 100 N/m^3 to so much."""
    model = (FIT.model + rtac.effects.CubicSpring(100.0)).fix(*fixed)
    known = information_of(np.array([[1.0 / std]]), ("cubic_spring.stiffness",), np.ones(1))
    return dataclasses.replace(FIT, model=model, information=known)


FOLLOWING: list[list[str]] = []
"""What `add_effects` was told to let follow the other direction, at each call."""


def extended(
    monkeypatch: pytest.MonkeyPatch, *, std: float = 1.0, by_simulation: bool = False, way: Any = "simulated",
    unseen: tuple[str, ...] = (), refuses_released: bool = False,
) -> tuple[Loop, str | None, list[frozenset[str]]]:  # fmt: skip
    """What became of a loop that was given a cubic spring, and what each model that was tried held."""
    tried: list[frozenset[str]] = []
    held = unseen

    FOLLOWING.clear()

    def add_effects(before: est.Fit, *_: Any, unseen: Sequence[str], **__: Any) -> Added | str:
        tried.append(before.model.fixed)
        FOLLOWING.append(list(unseen))
        if refuses_released and not set(held) <= set(before.model.fixed):
            return "Stopped: it shows nowhere."
        return Added(with_spring(std, tuple(before.model.fixed)), COMPARED, way)

    monkeypatch.setattr(improvement_loop, "add_effects", add_effects)
    base = dataclasses.replace(FIT, model=FIT.model.fix(*unseen))
    loop = dataclasses.replace(new_loop(), steps=[((), Added(base, COMPARED, "simulated"))], unseen=unseen)
    named = made_up_results.candidate("cubic_spring", 90.0)
    told = dataclasses.replace(made_up_results.diagnosis("missing"), effects=(named,), by_simulation=by_simulation)
    reason = loop.extend_by([rtac.effects.CubicSpring(100.0)], told)
    return loop, reason, tried


@pytest.mark.parametrize(
    ("options", "kept"),
    [
        ({"std": 40.0, "by_simulation": True}, True),
        ({"std": 60.0, "by_simulation": True}, False),
        ({"std": 60.0}, True),  # predictions named it
        ({"std": 60.0, "by_simulation": True, "way": "held"}, True),  # no simulation fitted it
    ],
)
def test_what_simulations_select_is_kept_only_if_their_fit_tells_it_from_nothing(
    options: dict[str, Any], kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop, reason, _ = extended(monkeypatch, **options)
    assert (reason is None) is kept
    assert len(loop.steps) == 1 + kept
    if not kept:
        assert reason == "Stopped: fitted by simulation, cubic_spring is not told from nothing."


@pytest.mark.parametrize("refuses", [False, True])
def test_what_the_base_model_could_not_show_is_released_where_it_can_be(
    refuses: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = next(name for name in FIT.model.free if "." in name)
    loop, reason, tried = extended(monkeypatch, unseen=(free,), refuses_released=refuses)
    assert reason is None
    assert [free in fixed for fixed in tried] == ([False, True] if refuses else [False])
    assert loop.unseen == ((free,) if refuses else ())


def test_friction_of_a_direction_that_still_shows_nowhere_is_to_go_with_the_other(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    loop, reason, _ = extended(monkeypatch, unseen=("arm_viscous.negative",), refuses_released=True)
    assert reason is None
    assert loop.unseen == ("arm_viscous.negative",)
    assert FOLLOWING == [[], ["arm_viscous.negative"]], "what is released follows nothing"
