"""What no effect of the catalogue explains is not named, alone or beside what one explains; the user's own effect may."""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
import pytest
from hidden_effects import SHORT, beyond_noise, diagnosed, recorded

import estimators as est
import rtac_jax as rtac
from estimators.reporting.report import report_dict
from rtac_jax import parameter
from rtac_jax.effects import CATALOGUE, Force

# What no effect of the catalogue is, and on which port it acts.
OUTSIDE = {
    "floor vibration": dict(vibration_force=0.05, vibration_frequency=7.0),
    "Maxwell spring": dict(maxwell_stiffness=10.0),
    "magnetic detent": dict(detent_force=0.05),
    "friction that grows along the way": dict(friction_slope=2.0),
}
IN_PART = "a cubic spring, and a little of what nobody knows"


@pytest.fixture(scope="module")
def recordings() -> dict[str, rtac.Recording]:
    return recorded({IN_PART: dict(cubic_spring=3e5, maxwell_stiffness=0.5)}, 12) | recorded(OUTSIDE, 14)


@pytest.fixture(scope="module")
def fitted(recordings: dict[str, rtac.Recording]) -> est.Fit:
    recording = recordings["magnetic detent"]
    return est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)


@pytest.fixture(scope="module")
def unknown(recordings: dict[str, rtac.Recording], fitted: est.Fit) -> est.Diagnosis:
    """Every look is taken at all that is offered before a verdict is "unknown", so here that is little."""
    return est.diagnose(fitted, recordings["magnetic detent"], candidates=SHORT[:4], progress=False)


def check_unknown(found: est.Diagnosis) -> None:
    assert found.verdict == "unknown", found
    assert found.effects == found.additions == ()
    assert found.latent[0].port == "cart"


@pytest.mark.slow
def test_what_was_not_offered_is_not_named(unknown: est.Diagnosis) -> None:
    check_unknown(unknown)
    assert unknown.curves[0].variable == "cart_position"


@pytest.mark.slow
def test_with_the_learned_force_the_error_of_another_recording_falls_by_half(
    recordings: dict[str, rtac.Recording], fitted: est.Fit, unknown: est.Diagnosis
) -> None:
    name = "magnetic detent"
    first = 14 + list(OUTSIDE).index(name)
    held_out = recorded({name: OUTSIDE[name]}, first, again=1)[name]
    learned = fitted.model + unknown.curves[0].effect()
    better = est.output_error(learned, recordings[name], from_model=True, progress=False)
    compared = est.compare([fitted, better], held_out, labels=["base", "learned"])
    before, after = beyond_noise(compared, 0), beyond_noise(compared, 1)
    assert max(before.values()) > 0.5
    assert sum(after.values()) < 0.5 * sum(before.values()), (before, after)


@pytest.mark.slow
@pytest.mark.parametrize("name", OUTSIDE)
def test_what_the_catalogue_does_not_know_is_not_named(recordings: dict[str, rtac.Recording], name: str) -> None:
    found = diagnosed(recordings[name])
    check_unknown(found)
    if name == "floor vibration":
        assert found.latent[0].frequency == pytest.approx(2 * np.pi * 7.0, rel=0.05)
        rms, doubt = found.latent[0].rms
        assert rms == pytest.approx(0.05 / np.sqrt(2), rel=0.2)
        assert rms == pytest.approx(0.05 / np.sqrt(2), abs=3 * doubt)
        assert doubt < 0.2 * rms
        assert len(found.latent[0].carried_by) == len(found.latent[0].experiments)


@pytest.mark.slow
def test_what_is_known_beside_it_is_named(recordings: dict[str, rtac.Recording]) -> None:
    found = diagnosed(recordings[IN_PART])
    assert found.verdict == "missing", found
    assert [c.id for c in found.effects] == ["cubic_spring"], found
    assert any(test.rejects for test in found.left), "what nobody knows stays visible"


class Detent(Force):
    """A magnet that a user suspects somewhere beneath the table."""

    id: ClassVar[str] = "detent"
    equation: ClassVar[str] = "-F z exp((1 - z^2) / 2), z = (q - q_0) / 1 mm"
    source: ClassVar[str] = "own rig"
    port: ClassVar[str] = "cart"
    strength: Any = parameter(symbol="F", unit="N", meaning="pull", null=0.0, plausible=lambda s: 0.05 * s.force)
    centre: Any = parameter(symbol="q_0", unit="m", meaning="place", plausible=tuple(1e-3 * n for n in range(-6, 7)))

    def force(self, motion: Any, own: Any) -> tuple[Any, Any]:
        away = (motion.cart_position - self.centre) / 1e-3
        return -self.strength * away * jnp.exp(0.5 * (1 - away**2)), 0.0


@pytest.mark.slow
def test_an_effect_of_the_users_own_is_named_fitted_and_reported(
    recordings: dict[str, rtac.Recording], fitted: est.Fit
) -> None:
    recording = recordings["magnetic detent"]
    found = est.diagnose(fitted, recording, candidates=[CATALOGUE["cubic_spring"], Detent], progress=False)
    assert found.verdict == "missing", found
    assert [c.id for c in found.effects] == ["detent"], found
    assert found.best is not None
    better = est.output_error(fitted.model + found.best, recording, from_model=True, progress=False)
    reported = report_dict(found, fit=better)
    assert [effect["id"] for effect in reported["effects"]] == ["detent"]
    for name, truth in (("strength", 0.05), ("centre", 3e-3)):
        said = reported["parameters"][f"detent.{name}"]
        assert said["value"] == pytest.approx(truth, abs=5 * said["std"] + 0.02 * truth), said
