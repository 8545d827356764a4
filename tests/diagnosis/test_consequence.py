"""Statistical and practical significance apart, and what the data could not show is never named: on made-up evidence."""

import dataclasses

import made_up_results
import pytest
from known_search import Known, known

from estimators.diagnosis.evidence import FittedModel, SimulationError
from estimators.diagnosis.explanation import words
from estimators.diagnosis.policy import STANDARD
from estimators.diagnosis.verdict import Judgement, decide
from estimators.misspecification.findings import Findings, Score

SPRING, LAG = (Score(name, place, ("size",), 100.0, 1e-9) for place, name in enumerate(("cubic_spring", "lvdt_lag")))


class Made(Known):
    """Of a rig on which a cubic spring, or else the lag of a sensor, raises the alarm, and whose simulation errors are given."""

    def __init__(self, gain: float, before: float, after: float, untestable: tuple[str, ...] = ()) -> None:
        super().__init__(known(base=0.0, cubic_spring=gain, lvdt_lag=0.9 * gain))
        self.facts = dataclasses.replace(self.facts, noise_known=True, untestable=untestable)
        self.errors, self.asked = (before, after), 0

    def findings(self, model: FittedModel) -> Findings:
        return Findings() if model.added else Findings(scores=(SPRING, LAG))

    def simulation(self, model: FittedModel) -> SimulationError:
        self.asked += 1
        error = self.errors[bool(model.added)]
        return SimulationError({"cart_position": error, "arm_velocity": 1.0}, {}, {"cart_position": 100.0}, (0.0, 0.0))


def judged(laboratory: Known) -> Judgement:
    return decide(laboratory, STANDARD, thorough=False)


@pytest.mark.parametrize(
    ("gain", "before", "after", "verdict"),
    [
        (60.0, 1.0966, 1.0965, "adequate"),  # 0.6 % and 0.01 %
        (60.0, 1.10, 1.05, "missing"),  # a simulation shows it
        (150.0, 1.0966, 1.0965, "missing"),  # predictions do: 1.5 %
        (60.0, 3.0, 2.99, "missing"),  # a simulation fails anyway: what is found may be a part of why
    ],
)
def test_what_takes_next_to_nothing_off_both_errors_is_of_no_consequence(
    gain: float, before: float, after: float, verdict: str
) -> None:
    found = judged(Made(gain, before, after))
    assert found.verdict == verdict
    assert found.consequence is not None
    assert found.consequence.predicted == pytest.approx(gain / 10_000, rel=0.02)
    named = found.detectable if verdict == "adequate" else found.steps
    assert [step.id for step in named] == ["cubic_spring"]
    assert bool(found.steps) == (verdict == "missing")


def test_a_simulation_is_asked_only_where_predictions_say_little() -> None:
    laboratory = Made(1000.0, 1.1, 1.0)
    found = judged(laboratory)
    assert found.consequence is not None
    assert found.consequence.simulated is None
    assert laboratory.asked == 0
    shown = judged(Made(60.0, 1.1, 1.05)).consequence
    assert shown is not None
    assert shown.simulated == pytest.approx(1 - 1.05 / 1.1)


def test_where_no_noise_is_known_predictions_alone_make_nothing_slight() -> None:
    laboratory = Made(60.0, 1.1, 1.1)
    laboratory.facts = dataclasses.replace(laboratory.facts, noise_known=False)
    assert judged(laboratory).verdict == "missing"


def test_what_the_data_could_not_show_is_never_named() -> None:
    assert judged(Made(1000.0, 5.0, 1.0)).effects == ("cubic_spring",)
    assert judged(Made(1000.0, 5.0, 1.0, untestable=("cubic_spring",))).effects == ("lvdt_lag",)
    neither = judged(Made(1000.0, 5.0, 1.0, untestable=("cubic_spring", "lvdt_lag")))
    assert neither.verdict == "unknown"
    assert not neither.effects


def test_of_many_effects_that_could_not_show_six_are_named_and_the_others_counted() -> None:
    several = [dataclasses.replace(made_up_results.candidate(f"effect_{n}", -3.0), testable=False) for n in range(8)]
    said = words("adequate", (), several, (), (), (), 1.0, (), (), (), ())
    assert "could not show effect_0, effect_1, effect_2, effect_3, effect_4, effect_5 and 2 others at any" in said
    said = words("adequate", (), several[:6], (), (), (), 1.0, (), (), (), ())
    assert "effect_4, effect_5 at any" in said
    large = dataclasses.replace(made_up_results.candidate("large", 50.0), testable=False)
    said = words("adequate", (), [*several[:1], large], (), (), (), 1.0, (), (), (), ())
    assert "could not show effect_0 at any" in said
