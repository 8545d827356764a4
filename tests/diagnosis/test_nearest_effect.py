"""The nearest effect as a last resort: where it explains most of what is missing and serves held-out experiments better."""

import dataclasses

import pytest
from hidden_effects import beyond_noise
from made_up_results import OTHERS, compared, diagnosis, improvement

import estimators as est
import rtac_jax as rtac
from estimators.core.fit import Parameter
from estimators.diagnosis import improve as loop
from estimators.diagnosis import nearest_effect
from estimators.diagnosis.model_extension import Added
from estimators.diagnosis.nearest_effect import nearest_of
from rtac_jax import virtual_rig
from rtac_jax.effects import CubicSpring


def candidate(**changes: object) -> est.Candidate:
    told = {"id": "cubic_spring", "testable": True, "refitted": True, "bic_gain": 50.0, "error_reduction": 0.8}
    told["parameters"] = {"stiffness": Parameter(7e4, 1e3, "N/m^3")}
    return dataclasses.replace(OTHERS[0], **(told | changes))


def unknown(*candidates: est.Candidate) -> est.Diagnosis:
    return dataclasses.replace(diagnosis("unknown"), candidates=candidates, additions=())


@pytest.fixture(scope="module")
def recording() -> rtac.Recording:
    """A cubic spring is hidden, and the diagnosis of these tests, which is made up, does not name it."""
    plans = virtual_rig.standard_plans(seed=61, sample_time=0.01, duration=4.0, free=2, forced=4, rest=1)
    return virtual_rig.record(virtual_rig.Rig(cubic_spring=8e4), plans, seed=71)


def improved(recording: rtac.Recording, found: est.Diagnosis, monkeypatch: pytest.MonkeyPatch) -> est.Improvement:
    monkeypatch.setattr(loop, "diagnose", lambda *_, **__: found)
    return est.improve(rtac.RTAC.from_rig(recording), recording, candidates=[CubicSpring], progress=False)


def test_it_is_added_and_called_likely(recording: rtac.Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    found = improved(recording, unknown(candidate()), monkeypatch)
    assert found.nearest is not None
    assert (found.verdict, found.added, found.learned) == ("unknown", (), None)
    before, after = (beyond_noise(found.validation, n) for n in (0, -1))
    assert sum(after.values()) < 0.5 * sum(before.values())
    assert found.final.parameters["cubic_spring.stiffness"].value == pytest.approx(8e4, rel=0.02)
    assert "no effect of the catalogue explains all of it. The nearest, cubic_spring, explains 80 %" in found.headline
    assert "it is likely, and not certain" in found.headline


@pytest.mark.parametrize(("error", "kept"), [(20.0, False), (10.0, True), (None, False)])
def test_one_that_does_not_help_is_not_added(
    recording: rtac.Recording, error: float | None, kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a fit with it leaves of held-out experiments, 20 times the noise without it; or why there is no fit."""
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    before = Added(fit, compared("base", 20.0), "simulated")
    after = "Stopped." if error is None else Added(before.fit, compared("+ cubic_spring", error), "simulated")
    monkeypatch.setattr(nearest_effect, "add_effect", lambda *_, **__: after)
    found = nearest_effect.add_nearest(
        before, unknown(candidate()), {"cubic_spring": CubicSpring}, recording, recording, progress=False
    )
    assert (found is not None) is kept


@pytest.mark.parametrize(
    "changes", [{"error_reduction": 0.4}, {"testable": False}, {"refitted": False}, {"bic_gain": -1.0}]
)
def test_what_explains_less_than_half_or_could_not_be_fitted_is_none(changes: dict[str, object]) -> None:
    assert nearest_of(unknown(candidate(**changes))) is None
    chosen = nearest_of(unknown(candidate(**changes), candidate(id="other", error_reduction=0.6)))
    assert chosen is not None
    assert chosen.id == "other"


def test_the_picture_and_the_bullets_call_it_likely() -> None:
    found = dataclasses.replace(
        improvement(2), diagnoses=(unknown(),), verdict="unknown", added=(), nearest=candidate()
    )
    labels = [text.get_text() for text in found.plot().axes[0].get_xticklabels()]
    assert labels[-1] == "+ cubic_spring, likely"
