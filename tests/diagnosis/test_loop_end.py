"""The end of the loop: next to nothing left of unknown noise, what is superseded, and fits that predictions lead."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import made_up_results
import numpy as np
import pytest
from made_up_loop import made, new_loop
from small_experiments import forced

import estimators as est
import rtac_jax as rtac
from estimators.core.fisher_information import Information
from estimators.core.fit import Parameter
from estimators.diagnosis import loop_end, loop_run
from estimators.diagnosis.evidence import EffectTraits, Evidence, Facts
from estimators.diagnosis.improvement_loop import Loop
from estimators.diagnosis.model_extension import Added
from estimators.diagnosis.runner_up import Exchange
from rtac_jax.effects import CurrentLag, Effect, EncoderLag


def ended(error: float, *, known: bool, verdict: str = "unknown", several: int = 1) -> Loop:
    """A loop whose last model misses so many times the noise of what was held out: 0.5 is 0.7 % of the motion, 3 are 2 %."""
    loop = new_loop()
    fit = dataclasses.replace(loop.last.fit, residual_std={"cart_position": 1e-5})
    loop.steps[0] = (), dataclasses.replace(loop.last, fit=fit, tested=made_up_results.compared("+ some", error))
    loop.added = [made_up_results.candidate("cubic_spring", 90.0)] * several
    effects = {"cubic_spring": EffectTraits()}
    facts = Facts(10_000, 2, 2, rest=known, noise_known=known, samples_per_radian=20.0, effects=effects)
    evidence = made(Evidence, facts=facts)
    loop.train = rtac.Recording((forced(noise_std={"cart_position": 2e-5} if known else None),))
    loop.diagnoses = [dataclasses.replace(made_up_results.diagnosis(verdict), evidence=evidence)]
    loop.stopped = "Stopped: no effect explains what is missing."
    return loop


def test_of_unknown_noise_no_last_resort_is_tried_for_less_than_a_hundredth_of_the_motion(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(loop_end, "_look_again", lambda _: pytest.fail("something more was asked"))
    monkeypatch.setattr(loop_end, "_resort", lambda *_, **__: pytest.fail("a last resort was tried"))
    loop = ended(0.5, known=False)
    end = loop_end.end_of(loop, last_resort=True)
    assert (end.loop is loop, end.learned, end.nearest, end.differs) == (True, None, None, None)
    assert not loop.looks_again
    assert (
        "Less than 1 % of the motion of the held-out experiments is missed, and nobody knows the noise" in loop.stopped
    )


@pytest.mark.parametrize(
    ("loop", "why"),
    [
        (ended(3.0, known=False), "two hundredths are missed"),
        (ended(0.5, known=True), "the noise is known"),
        (ended(0.5, known=False, verdict="adequate"), "nothing is missing"),
        (ended(0.5, known=False, several=0), "nothing was added"),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_elsewhere_all_is_asked(monkeypatch: pytest.MonkeyPatch, loop: Loop, why: str) -> None:
    asked: list[int] = []
    monkeypatch.setattr(loop_end, "_look_again", lambda _: asked.append(1))
    monkeypatch.setattr(loop_end, "_resort", lambda *_, **__: asked.append(2))
    loop_end.end_of(loop, last_resort=True)
    assert asked == [1, 2], why
    assert loop.looks_again == (why != "nothing is missing"), why


def fitted(size: float, deviation: float, error: float) -> Added:
    """Return a model with a lag of the encoder of a size and one of the current, which leaves an error over the noise."""
    model = rtac.RTAC.paper() + EncoderLag(size) + CurrentLag(6e-3)
    spread = np.where(np.array(model.free) == "encoder_lag.time_constant", deviation, 1e-5) ** 2
    known = Information(model.free, np.diag(spread), np.eye(len(spread)), np.ones(len(spread)))
    fit = dataclasses.replace(made_up_results.FIT, model=model, information=known)
    return Added(fit, made_up_results.compared("+ encoder_lag, current_lag", error), "simulated")


@pytest.mark.parametrize(
    ("size", "left", "dropped"),
    [(4e-5, 1.3, True), (4e-5, 1.6, False), (4e-5, None, False), (3e-4, 1.3, True), (6e-3, 1.3, False)],
)
def test_what_nothing_is_left_of_beside_what_was_added_later_goes(
    monkeypatch: pytest.MonkeyPatch, size: float, left: float | None, dropped: bool
) -> None:
    """Less than its deviations, or than a tenth of what was named; unless held-out experiments lose, or there is no fit."""
    loop = new_loop()
    loop.steps.append((("encoder_lag", "current_lag"), fitted(size, 6e-5, 1.3)))
    named = {"time_constant": Parameter(8e-3, 1e-5, "s")}
    loop.added = [made_up_results.candidate(name, 50.0, parameters=named) for name in ("encoder_lag", "current_lag")]
    loop.stopped = "Stopped: nothing more is missing."

    def without(
        last: Added, given_up: Sequence[str], several: Sequence[Effect], label: str, *_: Any, **__: Any
    ) -> Added | None:
        assert (given_up, several, label) == (["encoder_lag"], [], "+ current_lag")
        tested = None if left is None else made_up_results.compared(label, left)
        return None if tested is None else dataclasses.replace(last, tested=tested)

    monkeypatch.setattr(loop_end, "extended_without", without)
    loop_end.drop_superseded(loop)
    assert [c.id for c in loop.added] == (["current_lag"] if dropped else ["encoder_lag", "current_lag"])
    assert loop.steps[-1][0] == (("current_lag",) if dropped else ("encoder_lag", "current_lag"))
    assert loop.stopped.startswith("encoder_lag is left out again") == dropped


@pytest.mark.parametrize(("error", "left", "dropped"), [(63.0, 50.0, True), (63.0, 62.0, False), (8.0, 5.0, False)])
def test_what_was_added_at_once_and_held_out_experiments_refuse_goes(
    monkeypatch: pytest.MonkeyPatch, error: float, left: float, dropped: bool
) -> None:
    """Where they stay far off: a dead zone beside gravity made them worse. What is left is diagnosed again."""
    loop = new_loop()
    loop.steps.append((("encoder_lag", "current_lag"), fitted(8e-3, 1e-5, error)))
    named = {"time_constant": Parameter(8e-3, 1e-5, "s")}
    loop.added = [made_up_results.candidate(name, 50.0, parameters=named) for name in ("encoder_lag", "current_lag")]

    def without(
        last: Added, given_up: Sequence[str], several: Sequence[Effect], label: str, *_: Any, **__: Any
    ) -> Added:
        worse = given_up == ["current_lag"]
        return dataclasses.replace(last, tested=made_up_results.compared(label, 2 * error if worse else left))

    monkeypatch.setattr(loop_end, "extended_without", without)
    monkeypatch.setattr(Loop, "diagnosed_again", lambda *_, **__: made_up_results.diagnosis("unknown"))
    before = len(loop.diagnoses)
    loop_end.drop_superseded(loop)
    assert [c.id for c in loop.added] == (["current_lag"] if dropped else ["encoder_lag", "current_lag"])
    assert len(loop.diagnoses) == before + dropped
    assert ("the held-out error falls without it" in loop.stopped) == dropped


@pytest.mark.parametrize(("of_part", "of_all", "trains"), [(50.0, 50.0, 2), (50.0, 62.0, 2), (62.0, 50.0, 1)])
def test_what_goes_by_a_part_of_the_samples_goes_only_if_all_of_them_do_without(
    monkeypatch: pytest.MonkeyPatch, of_part: float, of_all: float, trains: int
) -> None:
    loop = dataclasses.replace(new_loop(), part=made(rtac.Recording))
    loop.steps.append((("encoder_lag", "current_lag"), fitted(8e-3, 1e-5, 63.0)))
    named = {"time_constant": Parameter(8e-3, 1e-5, "s")}
    loop.added = [made_up_results.candidate(name, 50.0, parameters=named) for name in ("encoder_lag", "current_lag")]
    asked: list[Any] = []

    def without(
        last: Added, given_up: Sequence[str], several: Sequence[Effect], label: str, train: Any, *_: Any, **__: Any
    ) -> Added:
        if given_up == ["current_lag"]:
            return dataclasses.replace(last, tested=made_up_results.compared(label, 200.0))
        asked.append(train)
        return dataclasses.replace(last, tested=made_up_results.compared(label, of_part if given_up else of_all))

    monkeypatch.setattr(loop_end, "extended_without", without)
    monkeypatch.setattr(Loop, "diagnosed_again", lambda *_, **__: made_up_results.diagnosis("unknown"))
    loop_end.drop_superseded(loop)
    assert asked == [loop.part, loop.train][:trains]
    dropped = of_part < 60 and of_all < 60
    assert [c.id for c in loop.added] == (["current_lag"] if dropped else ["encoder_lag", "current_lag"])


@pytest.mark.parametrize(
    ("error", "left", "verdict", "taken"),
    [
        (50.0, 1.2, "adequate", True),
        (50.0, 40.0, "adequate", False),
        (5.0, 1.2, "adequate", False),
        (50.0, 1.2, "unknown", False),
    ],
)
def test_a_fit_that_ended_far_off_is_led_by_predictions(
    monkeypatch: pytest.MonkeyPatch, error: float, left: float, verdict: str, taken: bool
) -> None:
    loop = new_loop()
    loop.steps.append((("encoder_lag",), fitted(6e-3, 1e-5, error)))
    loop.diagnoses = [made_up_results.diagnosis(verdict)]
    led = fitted(5e-3, 1e-5, left)
    predicted = made(est.PredictorFit, model=led.fit.model)
    monkeypatch.setattr(loop_end, "prediction_error_nonlinear", lambda *_, **__: predicted)
    monkeypatch.setattr(loop_end, "output_error", lambda *_, **__: led.fit)
    monkeypatch.setattr(loop_end, "compare", lambda *_, **__: made(est.Comparison, models=(led.tested,)))
    beside = loop_end.lead_by_predictions(loop)
    assert (loop.last.fit is led.fit) == taken
    asked = error > 10.0 and verdict == "adequate"
    assert (beside is predicted) == (asked and not taken), (
        "estimates by predictions are kept where no simulation serves better"
    )
    assert loop.steps[-1][0] == ("encoder_lag",)


@pytest.mark.parametrize(
    ("chi_square", "p_value", "thorough", "asked"),
    [
        (82.0, 0.01, True, [False, True]),
        (82.0, 0.01, False, [False]),
        (15.0, 0.01, True, [False]),
        (82.0, 1e-9, True, [False]),
    ],
)
def test_near_the_data_what_is_large_and_scatters_is_still_asked_for(
    monkeypatch: pytest.MonkeyPatch, chi_square: float, p_value: float, thorough: bool, asked: list[bool]
) -> None:
    """As a lag of the current behind one of the encoder, at six times a noise that nobody knows and 0.3 % of the motion."""
    loop = ended(0.5, known=False)
    large = made_up_results.candidate("current_lag", 90.0)
    large = dataclasses.replace(large, chi_square=chi_square, p_value=p_value)
    found = dataclasses.replace(
        made_up_results.diagnosis("adequate"), candidates=(large,), additions=(), evidence=loop.diagnoses[0].evidence
    )
    looks: list[bool] = []

    def diagnosed(self: Loop, *_: object, thorough: bool, **__: object) -> est.Diagnosis:
        looks.append(thorough)
        return found

    monkeypatch.setattr(Loop, "diagnosed_again", diagnosed)
    monkeypatch.setattr(Loop, "add", lambda *_: None)
    loop.thorough, loop.stopped = thorough, ""
    loop_run.run(loop)
    assert looks == asked
    assert loop.stopped == "Stopped: nothing more is missing."


@pytest.mark.parametrize(
    ("verdict", "left", "taken"), [("adequate", 5.0, True), ("unknown", 0.5, True), ("unknown", 1.6, False)]
)
def test_a_runner_up_stays_where_it_ends_adequate_or_at_the_noise(
    monkeypatch: pytest.MonkeyPatch, verdict: Any, left: float, taken: bool
) -> None:
    """A lag of the current left 1.1 times the noise where one of the encoder left 5.7, and a test rejected it all the same."""
    loop = ended(20.0, known=True, verdict="adequate")
    given_up, instead = loop.added[0], made_up_results.candidate("quadratic_spring", 90.0)
    step = dataclasses.replace(loop.last, tested=made_up_results.compared("+ other", left))
    monkeypatch.setattr(loop_run, "runner_up", lambda *_, **__: Exchange(step, instead, given_up))

    def run(further: Loop) -> None:
        further.diagnoses = [*further.diagnoses, made_up_results.diagnosis(verdict)]
        further.stopped = "Stopped."

    monkeypatch.setattr(loop_run, "run", run)
    further = loop_run.with_runner_up(loop)
    assert (further is not None) == taken
    if further is not None:
        assert [c.id for c in further.added] == ["quadratic_spring"]
