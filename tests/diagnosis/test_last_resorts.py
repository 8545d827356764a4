"""The last resorts of the loop, on the independent virtual rig.

A learned force for a hidden law that is in no catalogue, and the nearest effect where a diagnosis names none.
"""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from command_line import call, check_report, reported
from hidden_effects import beyond_noise

import estimators as est
import rtac_jax as rtac
from estimators.core.fit import Parameter
from estimators.diagnosis import improvement_loop as loop
from estimators.diagnosis import loop_end, loop_run
from estimators.diagnosis.learned_force import learn_force
from estimators.diagnosis.model_extension import Added, PredictedGain
from estimators.inference.simulation_residual import Cause, SimulationResidual
from estimators.misspecification.equation_curves import EquationCurve
from rtac_jax import virtual_rig
from rtac_jax.effects import CubicSpring, SplineForce

DETENT = virtual_rig.Rig(detent_force=0.05)  # a magnet beneath the table, which pulls the cart to one place
CUBIC = virtual_rig.Rig(cubic_spring=5e4)


def recorded(rig: virtual_rig.Rig) -> rtac.Recording:
    plans = virtual_rig.standard_plans(seed=61, sample_time=0.01, duration=4.0, free=2, forced=4, rest=1)
    return virtual_rig.record(rig, plans, seed=71)


def improved(recording: rtac.Recording, *, learned_force: bool = True) -> est.Improvement:
    model = rtac.RTAC.from_rig(recording)
    return est.improve(
        model, recording, candidates=[CubicSpring], thorough=False, learned_force=learned_force, progress=False
    )


@pytest.fixture(scope="module")
def recording() -> rtac.Recording:
    return recorded(DETENT)


@pytest.fixture(scope="module")
def learned(recording: rtac.Recording) -> est.Improvement:
    """Without its laws, of which each is a model of its own that has to be compiled."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop_end, "with_law", lambda _: None)
        return improved(recording)


def detent(at: np.ndarray) -> np.ndarray:
    """The force of the virtual rig's detent, from its docstring."""
    x = (at - DETENT.detent_position) / DETENT.detent_width
    return -DETENT.detent_force * x * np.exp(0.5 * (1.0 - x**2))


@pytest.mark.slow
def test_where_the_verdict_is_unknown_the_held_out_error_falls(learned: est.Improvement) -> None:
    assert learned.verdict == "unknown", learned
    assert learned.added == ()
    assert "spline_force" in learned.final.model
    before, after = (beyond_noise(learned.validation, n) for n in (0, -1))
    assert max(before.values()) > 5.0
    assert sum(after.values()) < 0.5 * sum(before.values()), (before, after)
    assert learned.validation.models[-1].label == "+ learned force"


@pytest.mark.slow
def test_it_is_the_force_of_the_rig_but_for_what_the_spring_takes(learned: est.Improvement) -> None:
    found = learned.learned
    assert found is not None
    assert (found.port, found.variable, found.unit) == ("cart", "cart_position", "N")
    fine = np.linspace(*found.between, 400)
    said, truth = np.interp(fine, found.at, found.force), detent(fine)
    left = said - truth
    slope = np.stack([fine, np.ones_like(fine)], axis=1)  # the model's spring, and where its sensor's zero is
    left = left - slope @ np.linalg.lstsq(slope, left, rcond=None)[0]
    assert np.std(left) < 0.5 * np.std(truth)


@pytest.mark.slow
def test_it_says_what_it_is_and_over_which_range(learned: est.Improvement, recording: rtac.Recording) -> None:
    found = learned.learned
    assert found is not None
    train, _ = recording.split()
    moved = np.concatenate([e.outputs["cart_position"].values for e in train.experiments])
    assert np.min(moved) <= found.between[0] < found.between[1] <= np.max(moved)
    assert (
        "no effect of the catalogue explains it. A learned force on the cart against cart_position" in learned.headline
    )
    assert "not a physical effect" in str(learned)
    assert "beyond that it is not known and keeps its last value" in str(learned)
    assert "It and spring_stiffness share what they do" in str(learned)


@pytest.mark.slow
def test_a_law_that_would_describe_it_is_proposed_where_none_explains_it_all(recording: rtac.Recording) -> None:
    found = improved(recording).learned
    assert found is not None
    assert found.laws


@pytest.fixture
def asked(
    learned: est.Improvement, recording: rtac.Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> list[dict[str, object]]:
    """A recording in a file, whose improvement is known, and the options that the command line asks for it with."""
    options: list[dict[str, object]] = []

    def known(*_: object, **given: object) -> est.Improvement:
        options.append(given)
        return learned

    monkeypatch.setattr(est, "improve", known)
    recording.save(tmp_path / "rig.h5")
    return options


@pytest.mark.slow
def test_the_command_line_says_and_writes_it(asked: list[dict[str, object]], tmp_path: Path) -> None:
    result = call("improve", tmp_path / "rig.h5", "--json", tmp_path / "x.json")
    assert "Learned force, not a physical effect" in result.stdout
    content = json.loads((tmp_path / "x.json").read_text())
    assert content["verdict"] == "unknown"
    assert content["learned_force"]["physical"] is False
    errors = content["error"]["validation"]
    before, after = (errors[moment]["cart_position"]["rms_over_noise"] for moment in ("before", "after"))
    assert after < 0.5 * before
    assert call("improve", tmp_path / "rig.h5", "--no-learned-force").exit_code == 0
    assert [one["learned_force"] for one in asked] == [True, False]


@pytest.mark.slow
def test_the_report_shows_it(asked: list[dict[str, object]], tmp_path: Path) -> None:
    result, folder, content = reported("improve", tmp_path / "rig.h5", tmp_path)
    assert "learned_force" in check_report(result, folder, content)
    page = (folder / "report.html").read_text()
    assert "a learned force was added, which is no physical effect" in page
    assert "It names no physics: it makes the error fall where it was learned" in page


@pytest.mark.slow
def test_it_is_saved_with_the_improvement(learned: est.Improvement, tmp_path: Path) -> None:
    learned.save(tmp_path / "x.h5")
    loaded = est.load(tmp_path / "x.h5")
    assert str(loaded.learned) == str(learned.learned)
    assert "spline_force" in loaded.final.model


@pytest.mark.slow
def test_it_can_be_left_out(
    learned: est.Improvement, recording: rtac.Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop, "diagnose", lambda *_, **__: learned.diagnoses[-1])
    left_out = improved(recording, learned_force=False)
    assert left_out.learned is None
    assert left_out.verdict == "unknown"
    assert len(left_out.fits) == 1


@pytest.mark.slow
def test_nothing_is_learned_where_an_effect_explains_it() -> None:
    found = improved(recorded(CUBIC))
    assert found.verdict == "missing", found
    assert found.learned is None
    assert "spline_force" not in found.final.model


@pytest.mark.slow
def test_nothing_is_learned_where_no_curve_explains_more_than_chance(
    learned: est.Improvement, recording: rtac.Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    train, held_out = recording.split()
    passing = tuple(dataclasses.replace(test, p_value=1.0) for test in learned.diagnoses[-1].tests)
    found = dataclasses.replace(learned.diagnoses[-1], tests=passing)
    said = learn_force(learned.base, learned.validation.models[0], found, train, held_out, progress=False)
    assert isinstance(said, str)
    assert "no function of position, velocity, angle or current" in said
    stands_in = SimulationResidual("stand-in", "cart_position", 5.0, 4.0, 0.15, 1.0, 0.0, "")
    beside = dataclasses.replace(found, simulation=stands_in)
    monkeypatch.setattr("estimators.diagnosis.learned_force.significant_equation_curves", lambda *_: [])
    said = learn_force(learned.base, learned.validation.models[0], beside, train, held_out, progress=False)
    assert isinstance(said, str)
    assert "beside random forces that stand in for the physics predictions do not tell" in said
    assert "the equations of motion along what was measured do not tell either" in said
    again = learn_force(
        learned.final, learned.validation.models[-1], learned.diagnoses[-1], train, held_out, progress=False
    )
    assert again == "No learned force was added: the model has one already."


@pytest.mark.slow
def test_where_predictions_follow_whatever_is_missing_the_equations_of_motion_say_what_is_learned(
    learned: est.Improvement, recording: rtac.Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And where they put the other parameters."""
    train, held_out = recording.split()
    passing = tuple(dataclasses.replace(test, p_value=1.0) for test in learned.diagnoses[-1].tests)
    stands_in = SimulationResidual("stand-in", "cart_position", 5.0, 4.0, 0.15, 1.0, 0.0, "")
    found = dataclasses.replace(learned.diagnoses[-1], tests=passing, simulation=stands_in)
    curve = next(one for one in learned.diagnoses[-1].curves if one.port == "cart")
    elsewhere = {"spring_stiffness": 123.0}
    monkeypatch.setattr(
        "estimators.diagnosis.learned_force.significant_equation_curves",
        lambda *_: [EquationCurve(curve, elsewhere, 0.6)],
    )
    asked = []

    def added(_: object, __: object, effects: list[SplineForce], *___: object, **options: object) -> Added:
        asked.append((effects[0], options["values"]))
        return Added(learned.final, learned.validation.models[-1], "simulated")

    monkeypatch.setattr("estimators.diagnosis.learned_force.add_effects", added)
    said = learn_force(learned.base, learned.validation.models[0], found, train, held_out, progress=False)
    assert not isinstance(said, str)
    force, values = asked[0]
    assert force.depends_on == curve.variable
    assert values == elsewhere


@pytest.mark.slow
def test_a_small_fall_near_the_noise_is_not_enough(
    learned: est.Improvement, recording: rtac.Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For an effect it is; for what names no physics nothing else speaks."""
    tested = learned.validation.models[-1]
    scaled = [dataclasses.replace(t, simulated=t.measured - 0.99 * t.residual) for t in tested.traces]
    slightly = dataclasses.replace(tested, traces=tuple(scaled))
    policies = []

    def added(*_: object, policy: est.DiagnosisPolicy, **__: object) -> Added:
        policies.append(policy)
        return Added(learned.final, slightly, "simulated")

    monkeypatch.setattr("estimators.diagnosis.learned_force.add_effects", added)
    train, held_out = recording.split()
    said = learn_force(learned.base, tested, learned.diagnoses[-1], train, held_out, progress=False)
    assert isinstance(said, str)
    assert "the held-out error does not clearly fall" in said
    assert {policy.near_noise for policy in policies} == {0.0}


@pytest.mark.parametrize(("times", "kept"), [(1.1, False), (0.99, True)])
@pytest.mark.slow
def test_what_predictions_gain_is_no_reason_for_a_curve_with_which_the_held_out_error_rises(
    learned: est.Improvement, recording: rtac.Recording, monkeypatch: pytest.MonkeyPatch, times: float, kept: bool
) -> None:
    tested = learned.validation.models[-1]
    scaled = [dataclasses.replace(t, simulated=t.measured - times * t.residual) for t in tested.traces]
    after = dataclasses.replace(tested, traces=tuple(scaled))
    gain = PredictedGain("spline_force", 50.0, {"cart_position": 2.0}, {"cart_position": 1.0})
    monkeypatch.setattr(
        "estimators.diagnosis.learned_force.add_effects",
        lambda *_, **__: Added(learned.final, after, "predicted", gain),
    )
    train, held_out = recording.split()
    said = learn_force(learned.base, tested, learned.diagnoses[-1], train, held_out, progress=False)
    assert isinstance(said, str) != kept


@pytest.mark.parametrize(("times", "kept"), [(2.2, False), (1.04, True)])
@pytest.mark.slow
def test_a_curve_with_which_more_of_what_was_fitted_is_missed_is_none(
    learned: est.Improvement, recording: rtac.Recording, monkeypatch: pytest.MonkeyPatch, times: float, kept: bool
) -> None:
    """Of an arm that creeps to rest in what was held out: 6.6 times the noise, and 0.9 with a curve that left 152 instead of 69."""
    before = learned.base
    left = {channel: times * size for channel, size in before.residual_std.items()}
    worse = dataclasses.replace(learned.final, residual_std=left)
    far, near = learned.validation.models[0], learned.validation.models[-1]
    monkeypatch.setattr(
        "estimators.diagnosis.learned_force.add_effects", lambda *_, **__: Added(worse, near, "simulated")
    )
    train, held_out = recording.split()
    said = learn_force(before, far, learned.diagnoses[-1], train, held_out, progress=False)
    assert isinstance(said, str) != kept


@pytest.mark.slow
def test_the_nearest_effect_is_added_and_called_likely(
    learned: est.Improvement, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A cubic spring is hidden, and the diagnosis, which is made up, does not name it."""
    nearest = dataclasses.replace(
        learned.diagnoses[-1].candidates[0],
        refitted=True, testable=True, bic_gain=50.0, error_reduction=0.8,
        parameters={"stiffness": Parameter(4e4, 1e3, "N/m^3")},
    )  # fmt: skip
    monkeypatch.setattr(
        loop, "diagnose", lambda *_, **__: dataclasses.replace(learned.diagnoses[-1], candidates=(nearest,))
    )
    monkeypatch.setattr(loop_end, "with_law", lambda _: None)  # its curve is that of another recording
    found = improved(recorded(CUBIC))
    assert found.nearest is not None
    assert (found.verdict, found.added, found.learned) == ("unknown", (), None)
    before, after = (beyond_noise(found.validation, n) for n in (0, -1))
    assert sum(after.values()) < 0.5 * sum(before.values())
    assert found.final.parameters["cubic_spring.stiffness"].value == pytest.approx(5e4, rel=0.03)
    assert "no effect of the catalogue explains all of it. The nearest, cubic_spring, explains 80 %" in found.headline
    assert "it is likely, and not certain" in found.headline


@pytest.mark.parametrize(("cause", "kept"), [("stand-in", False), ("unexplained", True)])
@pytest.mark.slow
def test_no_effect_is_added_where_random_forces_stand_in_for_the_physics(
    learned: est.Improvement, recording: rtac.Recording, cause: Cause, kept: bool
) -> None:
    """However far the held-out error falls with it: what leads that simulation is chance."""
    train, held_out = recording.split()
    error = SimulationResidual(cause, "cart_position", 200.0, 9.0, 0.7, 0.9, 0.0, "")
    passing = tuple(dataclasses.replace(test, p_value=1.0) for test in learned.diagnoses[-1].tests)
    said = dataclasses.replace(learned.diagnoses[-1], tests=passing, simulation=error)
    before, after = (Added(learned.fits[n], learned.validation.models[n], "simulated") for n in (0, -1))
    end = loop.Loop(train, held_out, None, 4, True, est.DiagnosisPolicy(), False, [((), before)], diagnoses=[said])
    assert (loop_run.last_resorted(end, (after, said.candidates[0]))[0] is not None) == kept
    assert (len(end.steps) == 2) == kept
