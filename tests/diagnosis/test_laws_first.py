"""A force of one variable that explains all that is missing: a law is read off it before anything else is looked for."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import made_up_results
import pytest
from known_search import Known, force, known, sized
from made_up_loop import made, new_loop

import estimators as est
from estimators.diagnosis import improvement_loop, loop_run, read_law
from estimators.diagnosis.evidence import FittedModel
from estimators.diagnosis.improvement_loop import Loop
from estimators.diagnosis.policy import STANDARD
from estimators.diagnosis.stepwise_selection import select
from estimators.misspecification.findings import Findings, Score
from estimators.misspecification.force_formulas import Formula


class Static(Known):
    """A rig of which a candidate explains a little, and a force against the cart's position so much."""

    def __init__(self, scores: Sequence[Score], explains: float, *, gain: float, left: float, rest: bool) -> None:
        super().__init__(known(base=0.0, cubic_spring=gain))
        self.facts = dataclasses.replace(self.facts, rest=rest)
        self.looked_again = False

        def found(model: FittedModel) -> Findings:
            if model.added:
                return Findings(curves=(force(left),) if left else ())
            return Findings(scores=tuple(scores), curves=(force(explains),))

        self.rejects = found

    def quiet_scores(self, model: FittedModel) -> tuple[Score, ...]:
        self.looked_again = True
        return ()


ALARM, SCATTERS = sized("cubic_spring", 60.0, 1e-9), sized("cubic_spring", 60.0, 0.5)


@pytest.mark.parametrize(
    ("scores", "explains", "gain", "left", "rest", "static"),
    [
        ([ALARM], 500.0, 30.0, 440.0, True, True),
        ([], 500.0, 0.0, 0.0, True, True),
        ([ALARM], 500.0, 30.0, 440.0, False, False),
        ([sized("cubic_spring", 700.0, 1e-9)], 500.0, 30.0, 440.0, True, False),
        ([SCATTERS], 500.0, 30.0, 440.0, True, True),
        ([sized("cubic_spring", 260.0, 0.5)], 500.0, 30.0, 440.0, True, False),
        ([ALARM], 500.0, 250.0, 0.0, True, False),
    ],
    ids=[
        "nearly all",
        "no candidate speaks",
        "noise unknown",
        "less than a test finds",
        "a small one scatters",
        "a large one scatters",
        "one explains it",
    ],
)
def test_nothing_more_is_looked_for_where_a_force_of_one_variable_explains_it(
    scores: list[Score], explains: float, gain: float, left: float, rest: bool, static: bool
) -> None:
    laboratory = Static(scores, explains, gain=gain, left=left, rest=rest)
    found = select(laboratory, STANDARD, thorough=True, laws_first=True)
    assert found.static == static
    unknown = found.named(10_000, STANDARD)[0] == "unknown"
    assert laboratory.looked_again == (unknown and not static)
    again = Static(scores, explains, gain=gain, left=left, rest=rest)
    assert not select(again, STANDARD, thorough=True).static
    assert again.looked_again == unknown


@pytest.mark.parametrize(("served", "after"), [(True, "adequate"), (True, "unknown"), (False, "")])
def test_where_a_law_serves_the_loop_ends_with_it_and_elsewhere_looks_again(
    monkeypatch: pytest.MonkeyPatch, served: bool, after: str
) -> None:
    asked: list[bool] = []

    def diagnosed(*_: Any, laws_first: bool, **__: Any) -> est.Diagnosis:
        asked.append(laws_first)
        return dataclasses.replace(made_up_results.diagnosis("unknown"), awaits_law=laws_first)

    def with_law(loop: Loop) -> Loop | None:
        if not served:
            return None
        further = loop.copied()
        further.stopped = "Stopped: with the law."
        further.diagnoses.append(made_up_results.diagnosis(after))
        return further

    monkeypatch.setattr(improvement_loop, "diagnose", diagnosed)
    monkeypatch.setattr(loop_run, "with_law", with_law)
    monkeypatch.setattr(loop_run, "_add_beyond_catalogue", lambda *_: False)
    loop = new_loop()
    loop_run.run(loop)
    ended = served and after == "adequate"
    assert asked == ([True] if ended else [True, False])
    assert loop.stopped == (
        "Stopped: with the law." if ended else "Stopped: no effect of the catalogue explains what is missing."
    )
    assert [d.verdict for d in loop.diagnoses] == (["unknown", "adequate"] if ended else ["unknown"])


def test_a_law_is_looked_for_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the end it is asked of the same model again."""
    loop, count = new_loop(), []
    loop.diagnoses, loop.diagnosed = [made_up_results.diagnosis("unknown")], [0]
    curve = made_up_results.curve("cart", "cart_velocity", 0.01)
    monkeypatch.setattr(loop_run, "static_force", lambda *_: (curve, True))
    monkeypatch.setattr(loop_run, "read_law", lambda *_, **__: count.append(1))
    assert loop_run.with_law(loop) is None
    assert loop_run.with_law(loop) is None
    assert len(count) == 1
    loop.steps.append(((), made(type(loop.last), fit=dataclasses.replace(loop.last.fit), tested=None, way="simulated")))
    assert loop_run.with_law(loop) is None
    assert len(count) == 2, "beside another fit it is asked again"


@pytest.mark.parametrize(
    ("beside", "after_first", "better", "asked"),
    [
        (True, "unknown", True, True),
        (True, "unknown", False, True),
        (True, "adequate", True, False),
        (False, "unknown", True, False),
    ],
    ids=["another does better", "none does", "the first will do", "nothing was added beside it"],
)
def test_beside_what_was_added_since_another_law_may_tell(
    monkeypatch: pytest.MonkeyPatch, beside: bool, after_first: str, better: bool, asked: bool
) -> None:
    """As a drive that saturates smoothly, of whose law the cube is the first term beside friction that nobody has named."""
    loop, laws = new_loop(), [made_up_results.candidate(name, 90.0) for name in ("law_cube", "law_saturation")]
    friction, curve = made_up_results.candidate("cart_stribeck", 50.0), made_up_results.curve("arm", "current", 0.01)
    step = dataclasses.replace(loop.last, tested=made_up_results.compared("+ law", 2.0))
    loop.steps = [((), dataclasses.replace(step, tested=made_up_results.compared("base", 7.0)))]
    first, second = (
        read_law.ReadLaw(step, law, made(Formula), given, curve)
        for law, given in zip(laws, ((), ("law_cube",)), strict=True)
    )
    runs: list[list[str]] = []

    def run(one: Loop) -> None:
        runs.append([c.id for c in one.added])
        if beside and len(runs) == 1:
            one.added.append(friction)
        one.diagnoses.append(made_up_results.diagnosis(after_first if len(runs) == 1 else "adequate"))
        one.stopped = "Stopped."

    tried: list[int] = []
    monkeypatch.setattr(loop_run, "other_law", lambda *_, **__: tried.append(1) or (second if better else None))
    monkeypatch.setattr(read_law, "_text", lambda *_: "a force")
    monkeypatch.setattr(loop_run, "run", run)
    further = loop_run.going_on(loop, first)
    assert bool(tried) == asked
    ended = ["cart_stribeck", "law_saturation"] if asked and better else ["law_cube", *(["cart_stribeck"] * beside)]
    assert [c.id for c in further.added] == ended
    assert further.ended_adequate == (after_first == "adequate" or (asked and better))
    assert further.stopped.startswith("a force is a law read off the missing force, in no catalogue, and is added:")
