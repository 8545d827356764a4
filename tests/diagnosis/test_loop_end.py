"""The end of the loop where next to nothing is left, and nobody knows the noise."""

import dataclasses

import made_up_results
import pytest
from made_up_loop import made, new_loop
from small_experiments import forced

import rtac_jax as rtac
from estimators.diagnosis import loop_end
from estimators.diagnosis.evidence import EffectTraits, Evidence, Facts
from estimators.diagnosis.improvement_loop import Loop


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
