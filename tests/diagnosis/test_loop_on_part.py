"""The loop of a long recording begins on a part of it, where that leads anywhere."""

import dataclasses
from typing import Any

import made_up_results
import numpy as np
import pytest
from made_up_loop import made, new_loop
from made_up_results import FIT

import estimators as est
import rtac_jax as rtac
from estimators.core.results import RESULTS, NotIdentifiableError
from estimators.diagnosis import loop_on_part
from estimators.diagnosis.evidence import Evidence
from estimators.diagnosis.improvement_loop import Loop
from estimators.diagnosis.model_extension import Added
from estimators.diagnosis.policy import STANDARD

FAR, NEAR = {"cart_position": 5e-3}, {"cart_position": 1e-6}
COMPARED = made_up_results.compared("+ cubic_spring", 2.0)
MENDED = dataclasses.replace(FIT, model=FIT.model + rtac.effects.CubicSpring(3e3))


def locked(samples: int) -> rtac.Recording:
    """Carts that swing by 10 mm beside locked arms, in five runs."""
    position = 1e-2 * np.cos(0.05 * np.arange(samples))
    return rtac.Recording(
        [
            rtac.Experiment.of(f"run_{n}", kind="free", sample_time=0.005, arm="locked", cart_position=position + 1e-6 * n)
            for n in range(5)
        ],
        {"total_mass": 1.5},
    )  # fmt: skip


def found(
    monkeypatch: pytest.MonkeyPatch, train: rtac.Recording, *, missed: Any = FAR, way: Any = "simulated", adds: bool = True,
    last: est.Fit | Exception = MENDED, in_time: bool = True, serves: bool = True,
) -> tuple[Loop | None, list[tuple[int, bool]]]:  # fmt: skip
    """What a part leads to, and the samples of every fit with whether it began from a model's values."""
    fitted: list[tuple[int, bool]] = []
    base = dataclasses.replace(FIT, residual_std=missed, noise={"cart_position": 1e-6})

    def output_error(model: Any, recording: rtac.Recording, *, from_model: bool = False, **_: Any) -> est.Fit:
        fitted.append((sum(e.samples for e in recording), from_model))
        if not from_model:
            return base
        if isinstance(last, Exception):
            raise last
        return last

    def add_first(loop: Loop) -> None:
        loop.stopped = "Stopped: nothing more is missing."
        loop.diagnoses.append(made_up_results.diagnosis("unknown"))
        loop.diagnosed.append(0)
        if not in_time:
            loop.stopped, loop.out_of_time, loop.not_added = "Stopped: time.", True, ("cubic_spring",)
        if adds:
            loop.added.append(made_up_results.candidate("cubic_spring", 90.0))
            step = Added(dataclasses.replace(MENDED, experiments=("part",)), COMPARED, way)
            loop.steps.append((("cubic_spring",), step))

    class _Compared:
        models = (COMPARED,)

    monkeypatch.setattr(loop_on_part, "output_error", output_error)
    monkeypatch.setattr(loop_on_part, "compare", lambda *_, **__: _Compared)
    monkeypatch.setattr(loop_on_part, "add_first", add_first)
    begun = dataclasses.replace(new_loop(), thorough=True, laws=True)
    before = made_up_results.compared("base", 20.0 if serves else 2.0)

    def loop_of(recording: rtac.Recording, fit: est.Fit) -> Loop:
        return dataclasses.replace(begun, train=recording, steps=[((), Added(fit, before, "simulated"))])

    model = rtac.RTAC.from_rig(train)
    return loop_on_part.loop_from_part(model, train, loop_of, STANDARD, progress=False), fitted


def test_all_samples_are_fitted_once_with_what_a_part_of_them_found(monkeypatch: pytest.MonkeyPatch) -> None:
    train = locked(8000)
    loop, fitted = found(monkeypatch, train)
    assert fitted == [(16_000, False), (40_000, True)]
    assert loop is not None
    assert loop.train is train
    assert (loop.thorough, loop.laws, loop.stopped) == (True, True, "")
    assert [names for names, _ in loop.steps] == [(), ("cubic_spring",)]
    assert loop.last.fit is MENDED
    assert loop.last.tested.label == "+ cubic_spring"
    assert (len(loop.diagnoses), [c.id for c in loop.added]) == (1, ["cubic_spring"])


@pytest.mark.parametrize(
    ("samples", "told", "fits"),
    [
        (3000, {}, 0),  # no long recording
        (8000, {"missed": NEAR}, 1),
        (8000, {"adds": False}, 1),
        (8000, {"way": "held"}, 1),  # no simulation serves
        (8000, {"last": NotIdentifiableError("the fit is lost")}, 2),
        (8000, {"serves": False}, 2),  # of all samples the held-out error does not fall
        (8000, {"last": dataclasses.replace(FIT, result=RESULTS.undetermined)}, 2),
    ],
)
def test_where_a_part_leads_nowhere_all_samples_are_begun_with(
    samples: int, told: dict[str, Any], fits: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop, fitted = found(monkeypatch, locked(samples), **told)
    assert loop is None
    assert len(fitted) == fits


def test_what_is_named_too_late_is_told_beside_the_base_model_of_all_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    train = locked(8000)
    loop, fitted = found(monkeypatch, train, adds=False, in_time=False)
    assert loop is not None
    assert fitted == [(16_000, False), (40_000, False)]
    assert (loop.train is train, loop.out_of_time, loop.not_added) == (True, True, ("cubic_spring",))
    assert (loop.stopped, len(loop.steps), len(loop.diagnoses)) == ("Stopped: time.", 1, 1)


def test_once_every_candidate_was_added_nothing_more_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop_on_part, "offered", lambda *_: [])
    loop, _ = found(monkeypatch, locked(8000))
    assert loop is not None
    assert loop.stopped == "Stopped: every candidate was added."


@pytest.mark.parametrize("by_more", [True, False])
def test_rivals_that_all_samples_would_tell_are_asked_of_all(by_more: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[float] = []

    def told_by_more(*given: Any) -> bool:
        asked.append(given[-1])
        return by_more

    told = dataclasses.replace(made_up_results.diagnosis("unknown"), evidence=made(Evidence))
    monkeypatch.setattr(loop_on_part, "told_by_more", told_by_more)
    monkeypatch.setattr(loop_on_part, "judge", lambda *_: None)
    monkeypatch.setattr(made_up_results, "diagnosis", lambda _: told)
    rival = made_up_results.candidate("cubic_spring", 90.0, confusable_with=("end_stop",))
    monkeypatch.setattr(made_up_results, "candidate", lambda *_: rival)
    loop, _ = found(monkeypatch, locked(8000))
    assert asked == [2.5]
    assert (loop is None) is by_more
