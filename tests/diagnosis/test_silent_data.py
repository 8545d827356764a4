"""A rig that all but rests: what dry friction holds says nothing, and nothing missing is no comfort then."""

import dataclasses

import made_up_results
import pytest
from made_up_loop import new_loop

import estimators as est
import rtac_jax as rtac
from estimators.diagnosis import improvement_loop, loop_end, loop_run
from estimators.diagnosis.evidence import EffectTraits, Facts
from estimators.misspecification.adequacy import AdequacyTest
from estimators.plots import plot_diagnosis
from estimators.plots.improvement import finding
from estimators.reporting.diagnosis_summary import of_diagnosis
from rtac_jax import virtual_rig

BLIND = {"effects": {"cubic_spring": EffectTraits(), "backlash": EffectTraits(contact=True)}}


@pytest.fixture(scope="module")
def diagnosis() -> est.Diagnosis:
    """A diagnosis with nothing missing, of a rig that moves."""
    plans = virtual_rig.standard_plans(seed=1, sample_time=0.005, duration=3.0, free=1, forced=2, rest=1)
    recording = virtual_rig.record(virtual_rig.Rig(), plans, seed=2)
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    several = [rtac.effects.CATALOGUE["cubic_spring"]]
    return est.diagnose(fit, recording, candidates=several, progress=False)


@pytest.fixture
def silent(diagnosis: est.Diagnosis) -> est.Diagnosis:
    """The same, as though hardly a sample had counted and nothing could have been shown."""
    assert diagnosis.evidence is not None
    facts = dataclasses.replace(diagnosis.evidence.facts, left_out=0.97, untestable=("cubic_spring",))
    evidence = dataclasses.replace(diagnosis.evidence, facts=facts)
    found = est.judge(evidence)
    assert (est.judge(diagnosis.evidence).verdict, found.verdict) == ("adequate", "unknown")
    assert (found.steps, found.simulation) == ((), None)
    return dataclasses.replace(diagnosis, evidence=evidence, verdict=found.verdict)


def test_what_moves_is_not_silent(diagnosis: est.Diagnosis) -> None:
    assert (diagnosis.verdict, diagnosis.silent) == ("adequate", "")


def test_pictures_and_report_say_so(silent: est.Diagnosis) -> None:
    assert silent.silent.startswith("These data say nothing of what the model lacks: 97 % of the samples do not count")
    improved = dataclasses.replace(
        made_up_results.improvement(1), diagnoses=(silent,), diagnosed=(0,), added=(), verdict="unknown"
    )
    assert improved.headline == f"{silent.silent}."
    assert "97 % of the samples do not count" in finding(improved)
    assert "say nothing" in plot_diagnosis(silent).get_suptitle().replace("\n", " ")
    bullets = str(of_diagnosis(improved, improved.train, improved.validation, file="rig.h5", estimates=None, doubts=()))
    assert "These data say nothing" in bullets
    assert "Drive the rig so hard" in bullets


def test_where_a_test_rejects_the_data_are_not_silent(silent: est.Diagnosis) -> None:
    line = AdequacyTest("spectral line", 1e-9, 400.0, 2e-3, "a line at 50 Hz")
    assert dataclasses.replace(silent, tests=(line,)).silent == ""


def test_a_picture_of_what_was_added_is_not_silent(silent: est.Diagnosis) -> None:
    found = dataclasses.replace(made_up_results.improvement(2), diagnoses=(silent,), diagnosed=(0,))
    assert found.added
    assert "do not count" not in finding(found)


def test_the_loop_ends_there(silent: est.Diagnosis, monkeypatch: pytest.MonkeyPatch) -> None:
    """No law, no learned force and no experiment that differs is looked for."""
    monkeypatch.setattr(improvement_loop, "diagnose", lambda *_, **__: silent)
    monkeypatch.setattr(loop_end, "_look_again", lambda _: pytest.fail("something more was asked"))
    loop = new_loop()
    loop_run.run(loop)
    assert loop.stopped == "Stopped: nothing can be told."
    end = loop_end.end_of(loop, last_resort=True)
    assert (end.loop is loop, end.learned, end.nearest, end.differs) == (True, None, None, None)


@pytest.mark.parametrize(
    ("left_out", "unfollowed", "stuck"), [(0.99, 0.98, True), (0.99, 0.1, False), (0.3, 0.98, False)]
)
def test_a_fit_that_rests_where_the_rig_moves_is_not_adequate(
    diagnosis: est.Diagnosis, left_out: float, unfollowed: float, stuck: bool
) -> None:
    assert diagnosis.evidence is not None
    facts = dataclasses.replace(diagnosis.evidence.facts, left_out=left_out, unfollowed=unfollowed)
    evidence = dataclasses.replace(diagnosis.evidence, facts=facts)
    verdict = est.judge(evidence).verdict
    assert verdict == ("unknown" if stuck else "adequate")
    told = dataclasses.replace(diagnosis, evidence=evidence, verdict=verdict)
    assert ("all but rests in its fit for 99 %" in told.silent) is stuck
    assert ("98 % of the motion" in told.silent) is stuck
    assert ("signs, units and offsets" in told.silent_mend) is stuck


@pytest.mark.parametrize(
    ("untestable", "left_out", "silent"),
    [(("cubic_spring",), 0.9, True), ((), 0.9, False), (("cubic_spring",), 0.4, False)],
    ids=["no effect would show", "one would", "most samples count"],
)
def test_data_are_silent_where_hardly_a_sample_counts_and_no_effect_would_show(
    untestable: tuple[str, ...], left_out: float, silent: bool
) -> None:
    facts = Facts(
        samples=10, seconds=1, experiments=1, rest=True, noise_known=True, samples_per_radian=20.0, untestable=untestable,
        left_out=left_out, **BLIND,
    )  # fmt: skip
    assert facts.silent is silent
    assert not dataclasses.replace(facts, effects={}).silent
