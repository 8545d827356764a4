"""Words after the loop are true of the model that it leaves, not only of the one that it began with."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from made_up_results import LEARNED, OTHERS, PREDICTED, compared, diagnosis, improvement

from estimators.core.fisher_information import information_of
from estimators.core.fit import Fit
from estimators.core.results import RESULTS
from estimators.diagnosis.caveats import reaching
from estimators.diagnosis.evidence import Evidence
from estimators.misspecification.adequacy import AdequacyTest
from estimators.plots.diagnosis import finding
from estimators.reporting.diagnosis_summary import of_diagnosis
from estimators.validation.simulation_error import Comparison
from rtac_jax import RTAC
from rtac_jax.effects import CubicSpring

NAMED = dataclasses.replace(diagnosis("missing"), additions=(CubicSpring(1.0),))


def looped(*diagnoses, steps=2, **changes):
    places = tuple(range(len(diagnoses)))
    return dataclasses.replace(improvement(steps), diagnoses=diagnoses, diagnosed=places, **changes)


@pytest.mark.parametrize(
    ("last", "words"),
    [
        ("adequate", "flexible_mode was missing; the mended model is adequate."),
        (
            "unknown",
            "flexible_mode was missing; the mended model still fails, and no effect of the catalogue explains it.",
        ),
        ("missing", "names does not serve held-out experiments."),
    ],
)
def test_the_headline_tells_what_was_missing_from_what_is(last, words):
    found = looped(NAMED, diagnosis(last))
    assert found.headline.endswith(words)
    assert found.mended == last
    assert repr(found) == f"Improvement: {found.headline}"


def test_a_model_at_the_noise_does_not_fail_as_one_that_is_far_from_it_does():
    found = dataclasses.replace(looped(NAMED, diagnosis("unknown"), steps=3), diagnosed=(0, 2))
    assert "the mended model leaves the held-out experiments at 1.08" in found.headline
    assert "times the noise, though a test of predictions rejects it, and no effect of the catalogue" in found.headline
    near = Comparison((compared("base", 0.3),))
    alone = dataclasses.replace(near_noise(diagnosis("unknown")), train=near)
    assert alone.headline.startswith("The model leaves the held-out experiments at 1.0")
    assert alone.headline.endswith(
        "times the noise, though a test of predictions rejects it, and no effect of the catalogue explains it."
    )


@pytest.mark.parametrize(
    ("verdict", "simulated", "known", "slight"),
    [
        ("unknown", 1.03, True, True),
        ("unknown", 1.4, True, False),
        ("unknown", 1.03, False, False),
        ("adequate", 1.03, True, False),
    ],
)
def test_what_only_predictions_tell_is_slight_where_the_noise_is_known(verdict, simulated, known, slight):
    evidence = Evidence.load(Path(__file__).parents[1] / "data" / "evidence" / "outside.json")
    facts = dataclasses.replace(evidence.facts, noise_known=known)
    found = dataclasses.replace(
        diagnosis(verdict), simulated=simulated, evidence=dataclasses.replace(evidence, facts=facts)
    )
    assert found.slight == slight
    said = of_diagnosis(found, Comparison((compared("base", 0.3),)), None, file="rig.h5").found
    assert ("is left at 1.03 times the noise, though tests of predictions reject the model" in said) == slight


def test_a_last_model_that_was_not_diagnosed_is_not_judged():
    found = looped(NAMED)
    assert found.mended is None
    assert found.headline == "flexible_mode was missing; the mended model was not diagnosed again."


@pytest.mark.parametrize(
    ("last", "left", "doubtful", "said"),
    [
        (None, 90.0, ("flexible_mode",), True),
        ("unknown", 90.0, ("flexible_mode",), True),
        ("adequate", 90.0, ("flexible_mode",), False),
        ("unknown", 1.3, ("flexible_mode",), False),
        ("unknown", 90.0, (), False),
    ],
)
def test_what_a_fit_far_from_the_data_does_not_tell_from_nothing_is_not_said_to_have_been_missing(
    last, left, doubtful, said
):
    """As a shaft of 2.3 +- 3.9 s^2, named of a motor whose supply sags, with the torque constant a fifth of its own."""
    found = looped(NAMED, *([diagnosis(last)] if last else []), doubtful=doubtful)
    found = dataclasses.replace(found, train=Comparison(tuple(compared(m.label, left) for m in found.train.models)))
    assert ("flexible_mode was missing" in found.headline) is not said
    assert ("what is missing is not known: flexible_mode was named" in found.headline) is said
    first = of_diagnosis(found, found.train, found.validation, file="rig.h5").found
    assert first.startswith("What is missing is not known: flexible_mode") is said


def test_a_group_is_named_as_a_group():
    rivals = dataclasses.replace(OTHERS[0], id="flexible_mode", confusable_with=("cubic_spring",))
    found = looped(NAMED, diagnosis("adequate"), added=(rivals,))
    assert found.headline.startswith(
        "One of a group was missing (flexible_mode, cubic_spring), and the data cannot tell which"
    )


def test_what_is_sure_is_not_lumped_with_a_group():
    sure, rivals = OTHERS[1], dataclasses.replace(OTHERS[0], id="force_offset", confusable_with=("lvdt_offset",))
    found = looped(NAMED, diagnosis("adequate"), added=(sure, rivals), steps=3)
    assert found.headline.startswith(
        f"{sure.id} was missing, and one of a group (force_offset, lvdt_offset), and the data cannot tell which"
    )


def test_a_group_is_named_once_and_without_what_is_sure():
    sure = OTHERS[1]
    first = dataclasses.replace(OTHERS[0], id="force_offset", confusable_with=("lvdt_offset", sure.id))
    second = dataclasses.replace(OTHERS[0], id="lvdt_offset", confusable_with=("force_offset",))
    found = looped(NAMED, diagnosis("adequate"), added=(first, second, sure), steps=3)
    assert found.headline.count("one of a group") == 1
    assert f"{sure.id} was missing" in found.headline


def test_an_adequate_model_whose_simulation_is_far_off_is_adequate_one_sample_ahead():
    far = improvement(2, errors=(90.0, 30.0))
    found = dataclasses.replace(far, diagnoses=(NAMED, diagnosis("adequate")), diagnosed=(0, 1))
    assert found.headline.endswith(
        "the mended model is adequate one sample ahead; of the held-out experiments its simulation leaves 23.8 times the noise."
    )
    assert "Even so, its simulation leaves" in found.ending


@pytest.mark.parametrize(("fitted", "held", "said"), [(1.3, 28.0, True), (1.3, 9.0, False), (3.0, 28.0, False)])
def test_a_model_that_misses_far_more_of_what_was_held_out_is_adequate_for_what_was_fitted_only(fitted, held, said):
    """As of a brake that dry and Stribeck friction stand for: 1.3 times the noise where they were fitted, 28 at small swings."""
    far = improvement(2, errors=(90.0, held))
    near = Comparison(tuple(compared(m.label, fitted) for m in far.train.models))
    found = dataclasses.replace(far, train=near, diagnoses=(NAMED, diagnosis("adequate")), diagnosed=(0, 1))
    assert (", for what was fitted only; of the held-out" in found.headline) is said
    base = dataclasses.replace(found, diagnoses=(diagnosis("adequate"),), added=(), diagnosed=(0,), verdict="adequate")
    assert (", for what was fitted only" in base.headline) is said


def test_what_serves_held_out_experiments_next_to_nothing_may_stand_for_something_else():
    """As a spring that a drifting sensor was taken for, with which 4.11 became 4.00 times the noise."""
    for after, said in ((40.0, "falls by 2.7 % only, so it may stand for something else"), (30.0, "")):
        one = dataclasses.replace(
            improvement(2, errors=(41.1, after)), diagnoses=(NAMED, diagnosis("adequate")), diagnosed=(0, 1)
        )
        assert said in one.headline
        assert ("may stand for something else" in one.headline) is bool(said)
    kept = dataclasses.replace(
        one, predicted_gains=(PREDICTED,), validation=improvement(2, errors=(41.1, 40.0)).validation
    )
    assert "something else" not in kept.headline  # which says what it is kept for


@pytest.mark.parametrize("steps", [1, 2])
@pytest.mark.parametrize(
    ("fitted", "coloured", "said"), [(0.3, (), True), (1.5, (), False), (0.3, ("arm_velocity",), False)]
)
def test_held_out_experiments_beyond_the_noise_are_told_of_a_model_that_follows_the_fitted_ones(
    steps, fitted, coloured, said
):
    """Of noise that is coloured, or where the fitted ones are as far, it is no news."""
    found = looped(*(NAMED, diagnosis("adequate"))[2 - steps :], steps=steps)
    levels = dict.fromkeys(coloured, 0.1)
    several = [compared(model.label, 1.5) for model in found.validation.models]
    beyond = [dataclasses.replace(m, traces=tuple(t for t in m.traces if t.channel == "arm_velocity")) for m in several]
    trained = Comparison(tuple(compared(model.label, fitted) for model in several))
    tested = Comparison(tuple(beyond))
    found = dataclasses.replace(found, train=trained.with_noise(levels), validation=tested.with_noise(levels))
    assert ("; of the held-out experiments its simulation leaves 1.61 times the noise." in found.headline) == said
    assert "adequate" in found.headline


def near_noise(found):
    """Return a loop that adds nothing, whose held-out experiments are followed to the noise."""
    return dataclasses.replace(looped(found, steps=1), validation=Comparison((compared("base", 0.3),)))


def test_an_adequate_model_that_is_far_from_the_held_out_experiments_says_so():
    found = looped(diagnosis("adequate"), steps=1)
    far = max(e.rms_over_noise for e in found.validation.models[-1].errors.values())
    assert far > 10
    assert found.headline.endswith(f"; of the held-out experiments its simulation leaves {far:.1f} times the noise.")
    farther = dataclasses.replace(found, validation=Comparison((compared("base", 300.0),)))
    errors = farther.validation.models[-1].errors.values()
    worst = max(errors, key=lambda e: e.rms_over_noise)  # and not the channel that is followed least
    missed = 100 - worst.fit_percent
    assert 10 < missed < max(100 - e.fit_percent for e in errors)
    assert farther.headline.endswith(f" times the noise, {missed:.0f} % of their motion.")
    assert "lead it away, which predictions one sample ahead do not tell apart" in found.ending
    followed = dataclasses.replace(found, train=near_noise(diagnosis("adequate")).validation)
    assert "the held-out ones may reach beyond what was fitted, differ from it" in followed.ending


def test_an_adequate_model_that_misses_most_of_the_held_out_motion_does_not_follow_it():
    found = looped(diagnosis("adequate"), steps=1)
    assert found.headline.startswith("The model is adequate: nothing is missing")
    lost = dataclasses.replace(found, validation=Comparison((compared("base", 3000.0),)))
    assert min(e.fit_percent for e in lost.validation.models[-1].errors.values()) < 50
    assert lost.headline.startswith("The model does not follow what was held out: nothing is missing")
    mended = dataclasses.replace(
        looped(diagnosis("missing")), diagnoses=(diagnosis("missing"), diagnosis("adequate")), diagnosed=(0, 1)
    )
    assert "the mended model is adequate" in mended.headline
    models = (*mended.validation.models[:-1], compared("+ flexible_mode", 3000.0))
    lost = dataclasses.replace(mended, validation=Comparison(models))
    assert "the mended model does not follow what was held out" in lost.headline


def test_a_quarter_is_as_much_where_what_was_fitted_is_followed_to_the_noise():
    """A spring that softens was held out, 2.3 times as far as what was fitted: "adequate" at 31 % of that motion."""
    found = looped(diagnosis("adequate"), steps=1)
    fitted = compared("base", 0.3)
    far = [dataclasses.replace(t, simulated=t.measured - 0.3 * np.std(t.measured)) for t in fitted.traces]
    tested = dataclasses.replace(fitted, traces=tuple(far))
    assert all(50 < e.fit_percent < 75 for e in tested.errors.values())
    shaken = dataclasses.replace(found, validation=Comparison((tested,)))
    assert shaken.headline.startswith("The model is adequate: nothing is missing")
    followed = dataclasses.replace(shaken, train=Comparison((fitted,)))
    assert followed.headline.startswith("The model does not follow what was held out: nothing is missing")


def test_what_reaches_farther_than_all_that_was_fitted_is_named_with_what_to_do():
    fitted = compared("base", 0.3, names=("free_1", "forced_1"))
    tested = compared("base", 0.3, names=("free_2", "forced_2"))
    assert reaching(fitted, tested) == ""
    far = [
        dataclasses.replace(t, measured=2.0 * t.measured)
        if (t.experiment, t.channel) == ("free_2", "cart_position")
        else t
        for t in tested.traces
    ]
    said = reaching(fitted, dataclasses.replace(tested, traces=tuple(far)))
    assert re.match(r"free_2 moves (1\.9|2\.0|2\.1) times as far in cart_position as anything that was fitted", said), (
        said
    )
    assert "--validation" in said


def test_nothing_added_is_said_as_what_it_is():
    quiet = dataclasses.replace(diagnosis("adequate"), random_force=1e-3, random_torque=2e-3)
    assert near_noise(quiet).headline == "The model is adequate: nothing is missing at the noise floor."
    off = dataclasses.replace(quiet, simulated=1.61)
    assert near_noise(off).headline.endswith(
        "nothing is missing predicted one sample ahead; its simulation is left at 1.61 times the noise."
    )
    assert dataclasses.replace(quiet, simulated=1.1).floor == "at the noise floor"
    assert looped(diagnosis("unknown"), steps=1).headline.startswith("The model fails, and no effect of the catalogue")
    assert looped(diagnosis("adequate"), steps=1).mended is None


def test_a_model_whose_predictor_asks_for_random_forces_is_held_against_predictions_alone():
    """Its simulation may be far from the noise."""
    forced = dataclasses.replace(diagnosis("adequate"), random_torque=0.16)
    assert near_noise(forced).headline == (
        "The model is adequate: nothing is missing predicted one sample ahead, which counts random forces."
    )


def test_a_last_fit_that_did_not_converge_is_told():
    found = looped(diagnosis("adequate"), steps=1)
    known = information_of(np.eye(1), ("total_mass",), np.ones(1))
    statistics = {"agreed": 1, "starts": 1, "promised": 2500.0}
    fit = Fit(RTAC.paper(), RESULTS.steps_exhausted, known, {}, {}, {}, (), statistics)
    assert "did not converge" not in found.ending
    assert "The last model: The fit did not converge" in dataclasses.replace(found, fits=(fit,)).ending


def test_what_was_learned_is_called_no_physical_effect():
    found = looped(diagnosis("unknown"), verdict="unknown", added=(), learned=LEARNED)
    assert found.headline.startswith(
        "The model fails, and no effect of the catalogue explains it. A learned force on the cart"
    )
    assert "which is no physical effect, changes the held-out error of cart_position from" in found.headline
    assert "learned from -0.012 to 0.014 m; beyond that it is not known and keeps its last value" in found.ending
    assert "Experiments held out that go beyond: forced_1 (20 % of the samples)" in found.ending
    mended = looped(NAMED, diagnosis("unknown"), steps=3, added=NAMED.effects, learned=LEARNED)
    assert mended.headline.startswith("flexible_mode was missing; the mended model still fails")
    assert mended.mended == "unknown"


def test_deviations_are_said_to_count_what_is_held_only_where_they_do():
    found = looped(NAMED, diagnosis("adequate"), held=("flexible_mode",))
    counted = "Standard deviations of the others count how well the diagnosis knew it."
    assert counted not in found.ending
    last = dataclasses.replace(found.final, held={"flexible_mode.mass": 0.01})
    assert counted in dataclasses.replace(found, fits=(*found.fits[:-1], last)).ending


@pytest.mark.parametrize(
    ("simulated", "others", "told"), [(1.02, (), True), (1.6, (), False), (1.02, ("static force",), False)]
)
def test_a_line_alone_beside_a_simulation_at_the_noise_is_no_failure_of_the_model(simulated, others, told):
    line = AdequacyTest(
        "spectral line", 1e-9, 100.0, 2e-3, "the strongest line, at 314 rad/s (50 Hz, that of the mains)"
    )
    tests = (line, *(AdequacyTest(name, 1e-9, 100.0, 2e-3, "of another") for name in others))
    found = looped(
        dataclasses.replace(diagnosis("unknown"), tests=tests, simulated=simulated),
        steps=1,
        added=(),
        verdict="unknown",
    )
    beginning = f"The model follows the recording to {simulated:.2f} times the noise, and only a line speaks against it"
    assert found.headline.startswith(beginning if told else "The model fails")
    assert ("50 Hz, that of the mains" in found.headline) == told
    assert (
        "Only a line speaks against the model" in str(of_diagnosis(found, found.train, found.validation, file="x"))
    ) == told


def test_a_report_on_a_failing_model_sends_to_the_faults_of_the_recording_first():
    found = looped(diagnosis("unknown"), steps=1, added=(), verdict="unknown")
    doubts = ("free_1: its samples stop.",)
    said = str(of_diagnosis(found, found.train, found.validation, file="x", doubts=doubts))
    assert "Mend the recording first, or leave out what is wrong, and ask again. free_1: its samples stop." in said
    fine = looped(diagnosis("adequate"), steps=1, added=(), verdict="adequate")
    assert "Mend the recording" not in str(of_diagnosis(fine, fine.train, fine.validation, file="x", doubts=doubts))


@pytest.mark.parametrize(
    ("simulated", "rounded", "told"),
    [(1.02, {"cart_position": 1e-4}, True), (1.6, {"cart_position": 1e-4}, False), (1.02, {}, False)],
)
def test_what_rounding_may_do_is_no_failure_of_the_model(simulated, rounded, told):
    lag = AdequacyTest("delayed force", 1e-9, 67.0, 2e-3, "a force that follows cart_position with a lag", alarmed=True)
    last = dataclasses.replace(diagnosis("unknown"), tests=(lag,), simulated=simulated, rounded=rounded)
    found = looped(last, steps=1, added=(), verdict="unknown")
    said = str(of_diagnosis(found, found.train, found.validation, file="x"))
    assert found.headline.startswith("The model follows the recording to 1.02" if told else "The model fails")
    for text in (found.headline, said):
        assert (
            "cart_position in steps of 0.0001 m, whose rounding is no random noise; a force that follows" in text
        ) == told


def test_errors_are_held_against_the_coloured_noise_where_the_words_are():
    """Words said 1.02 times the noise, and the table beside them eight times that of the fastest changes."""
    coloured, line = {"cart_position": 3e-6}, AdequacyTest("spectral line", 1e-9, 67.0, 2e-3, "a line", alarmed=True)
    told = {
        verdict: dataclasses.replace(diagnosis(verdict), coloured=coloured, simulated=1.02)
        for verdict in ("adequate", "unknown")
    }
    assert told["adequate"].colour_told == coloured
    assert told["unknown"].colour_told == {}  # it may stand for what is missing
    assert dataclasses.replace(told["unknown"], tests=(line,)).colour_told == coloured
    assert dataclasses.replace(told["unknown"], tests=(line,), simulated=8.0).colour_told == {}


@pytest.mark.parametrize("steps", [1, 2])
def test_a_drift_is_told_of_the_base_model_and_of_the_mended_one(steps):
    drift = AdequacyTest("drift", 1e-9, 400.0, 2e-3, "arm_viscous.positive that changes would explain 400")
    last = dataclasses.replace(diagnosis("unknown"), left=(drift,))
    diagnoses = (NAMED, last)[2 - steps :]
    found = looped(*diagnoses, steps=steps, added=NAMED.effects[: steps - 1], verdict="unknown")
    assert f"fails as where a parameter drifts: {drift.words}" in found.headline
    said = str(of_diagnosis(found, found.train, found.validation, file="x"))
    assert drift.words in said
    assert "Let the rig run before it is recorded" in said
    assert finding(last) == "The model fails as where a parameter drifts: arm_viscous.positive that changes"
    other = AdequacyTest("static force", 1e-9, 300.0, 2e-3, "a force that depends on cart_position")
    beside = dataclasses.replace(last, left=(drift, other))
    assert "drifts" not in looped(*diagnoses[:-1], beside, steps=steps, added=found.added, verdict="unknown").headline


def test_the_recording_is_settled_where_effects_alone_make_the_model_follow_all_of_it():
    found = looped(NAMED, diagnosis("adequate"), train=Comparison((compared("base", 20.0), compared("+ it", 0.8))))
    near = dataclasses.replace(found, validation=found.train)
    assert near.settled
    assert not found.settled, "held-out experiments are at three times the noise"
    for last_resort in ({"learned": LEARNED}, {"nearest": OTHERS[0]}, {"left_out": "free_1"}):
        assert not dataclasses.replace(near, **last_resort).settled
    assert not dataclasses.replace(near, diagnoses=(NAMED, diagnosis("unknown"))).settled
    assert not looped(diagnosis("adequate"), steps=1, train=near.train, validation=near.train).settled
