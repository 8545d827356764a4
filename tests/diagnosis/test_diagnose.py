"""Hidden effects, made by the independent virtual rig, are named; with nothing hidden nothing is."""

import dataclasses
import sys
from typing import Any

import numpy as np
import pytest
from hidden_effects import SHORT, diagnosed, recorded

import estimators as est
import rtac_jax as rtac
from rtac_jax import virtual_rig
from rtac_jax.effects import CATALOGUE, Effect

# What the rig hides, and which parameter of the model's effect should come out at which value. A new one goes last: rigs are
# numbered by their place.
HIDDEN = {
    "cubic_spring": (dict(cubic_spring=5e4), {"stiffness": 5e4}),
    "quadratic_spring": (dict(quadratic_spring=600.0), {"stiffness": 600.0}),
    "flexible_mode": (
        dict(flexible_mass=0.08, flexible_frequency=37.4, flexible_damping=0.03),
        {"mass": 0.08, "frequency": 37.4},
    ),
    "cart_quadratic_drag": (dict(cart_quadratic_drag=2.0), {"coefficient": 2.0}),
    "arm_coulomb": (dict(arm_coulomb=4e-4), {"level": 4e-4}),
    "gravity_tilt": (dict(tilt_across=0.01), {"across": 0.01}),
    "cogging": (dict(cogging_torque=4e-4, cogging_order=7.0, cogging_phase=0.7), {"harmonic": 7.0}),
    "current_lag": (dict(current_lag=0.01), {"time_constant": 0.01}),
    "dead_zone": (dict(dead_zone=0.01), {"threshold": 0.01}),
    "current_offset": (dict(current_offset=0.005), {"offset": 0.005}),
    "tacho_bias": (dict(tacho_bias=0.2), {"bias": 0.2}),
    "torque_ripple": (
        dict(torque_ripple=0.04, torque_ripple_order=6.0, torque_ripple_phase=0.0),
        {"sine": 0.04, "cosine": 0.0, "harmonic": 6.0},
    ),
    "cart_asymmetric_friction": (dict(cart_asymmetry=0.15), {"coefficient": 0.15}),
    "arm_load_friction": (dict(arm_load_friction=0.05), {"fraction": 0.05}),
    "tacho_delay": (dict(tacho_delay=0.005), {"delay": 0.005}),
}
# Every run of the tests names two of the whole catalogue, one by `rtac demo` and one by the README: each takes half a minute.
CASES = [
    pytest.param("cubic_spring", SHORT, id="cubic_spring among a few", marks=pytest.mark.slow),
    *(pytest.param(name, None, id=name, marks=pytest.mark.slow) for name in HIDDEN),
]
# What the paper's model has, where a model lacks it.
PAPERS_OWN = ("cart_viscous", "cart_coulomb", "arm_viscous")


SHAKEN_SEED = (
    41_414_382_410  # of the rig in the study of docs/study_log.md, draw 13, on which the wrong effect was named
)


@pytest.fixture(scope="module")
def recordings() -> dict[str, rtac.Recording]:
    hidden = {name: values for name, (values, _) in HIDDEN.items()}
    others: dict[str, dict[str, Any]] = {"two effects": dict(cubic_spring=5e4, current_lag=0.01), "nothing": {}}
    return recorded(hidden, 0) | recorded(others, 12)


@pytest.fixture(scope="module")
def fit_of_nothing(recordings: dict[str, rtac.Recording]) -> est.Fit:
    recording = recordings["nothing"]
    return est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)


@pytest.mark.parametrize(("name", "candidates"), CASES)
def test_hidden_effect_is_named(
    recordings: dict[str, rtac.Recording], name: str, candidates: tuple[type[Effect], ...] | None
) -> None:
    found = diagnosed(recordings[name], candidates)
    assert found.verdict == "missing", found
    assert [c.id for c in found.effects] == [name], found
    assert found.effects[0].error_reduction > 0.9
    estimates = found.effects[0].parameters
    for one, truth in HIDDEN[name][1].items():
        estimate = estimates[one]
        assert estimate.value == pytest.approx(truth, abs=5 * estimate.std + 0.02 * abs(truth)), (one, estimate)
    assert found.best is not None
    assert found.best.id == name
    assert found.evidence is not None
    assert est.judge(found.evidence).effects == (name,)
    assert any(test.rejects for test in found.tests)
    assert "repeats" in {test.test for test in found.tests}


# A stop that is hit by one swing raises no alarm, and a ripple of the LVDT may not; a soft shaft and a backlash look like
# random torques, which hide them from the predictor.
QUIET = {
    "end_stop": (
        dict(end_stop_travel=0.012, end_stop_stiffness=300.0, force_noise=1e-3, torque_noise=3e-5), {"travel": 0.012}
    ),
    "flexible_shaft": (dict(shaft_stiffness=0.3, shaft_damping=2e-5), {"rotor": 0.3}),
    "backlash": (dict(backlash=0.1), {"gap": 0.1, "rotor": 0.3}),
    "backlash, shaken": (dict(backlash=0.1, force_noise=1e-3, torque_noise=3e-5), {"gap": 0.1, "rotor": 0.3}),
    "lvdt_ripple": (
        dict(lvdt_ripple=6e-5, lvdt_ripple_pitch=1.85e-3, force_noise=1e-3, torque_noise=3e-5), {"pitch": 1.85e-3}
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", QUIET)
def test_what_raises_no_alarm_is_found(name: str) -> None:
    values, truth = QUIET[name]
    name = name.removesuffix(", shaken")
    rig = dataclasses.replace(virtual_rig.Rig().drawn(501), **values)
    plans = virtual_rig.standard_plans(seed=502, sample_time=0.002, duration=5.0, free=2, forced=4, rest=1, repeats=1)
    found = diagnosed(virtual_rig.record(rig, plans, seed=503))
    assert found.verdict == "missing", found
    assert [c.id for c in found.effects] == [name], found
    why = "This is what simulations select" if found.by_simulation else f"{name} raised no alarm by itself"
    assert why in found.explanation
    assert ("may be far too narrow" in found.explanation) == (name == "backlash")
    for one, value in truth.items():
        assert found.effects[0].parameters[one].value == pytest.approx(value, rel=0.02)


@pytest.mark.slow
def test_random_forces_do_not_make_stribeck_friction_of_drag() -> None:
    """They shake a decay that has all but ended; counted, its last second and a half outweighs all that tells the two apart."""
    rig = virtual_rig.Rig().drawn(SHAKEN_SEED)
    rig = dataclasses.replace(rig, cart_quadratic_drag=2.0, force_noise=1e-3, torque_noise=3e-5)
    plans = virtual_rig.standard_plans(
        seed=SHAKEN_SEED + 1, sample_time=0.002, duration=5.0, free=2, forced=4, rest=1, repeats=1
    )
    found = diagnosed(virtual_rig.record(rig, plans, seed=SHAKEN_SEED + 2))
    assert [c.id for c in found.effects] == ["cart_quadratic_drag"], found
    assert found.effects[0].parameters["coefficient"].value == pytest.approx(2.0, rel=0.15)
    assert "of the samples do not count" in found.explanation


@pytest.mark.parametrize("candidates", [SHORT, pytest.param(None, marks=pytest.mark.slow)], ids=["short", "whole"])
def test_nothing_hidden_is_adequate(
    fit_of_nothing: est.Fit, recordings: dict[str, rtac.Recording], candidates: tuple[type[Effect], ...] | None
) -> None:
    found = est.diagnose(fit_of_nothing, recordings["nothing"], candidates=candidates, progress=False)
    assert found.verdict == "adequate", found
    assert found.best is None
    assert found.effects == found.latent == ()
    assert not any(test.rejects for test in found.tests)
    assert all(np.isfinite(c.detection_limit) for c in found.candidates if c.testable)


@pytest.mark.slow
@pytest.mark.parametrize("candidates", [SHORT, None], ids=["short", "whole"])
def test_two_effects_are_named(
    recordings: dict[str, rtac.Recording], candidates: tuple[type[Effect], ...] | None
) -> None:
    found = diagnosed(recordings["two effects"], candidates)
    assert found.verdict == "missing", found
    assert sorted(c.id for c in found.effects) == ["cubic_spring", "current_lag"], found
    assert not any(test.rejects for test in found.left), found


def test_what_was_not_fitted_is_not_diagnosed(
    recordings: dict[str, rtac.Recording], fit_of_nothing: est.Fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = recordings["nothing"]
    other = dataclasses.replace(recording.experiments[0], name="never fitted")
    more = dataclasses.replace(recording, experiments=(*recording.experiments, other))
    seen: list[tuple[str, ...]] = []

    def setting_of(fit: est.Fit, recording: rtac.Recording, *_: Any, **__: Any) -> None:
        seen.append(recording.names)
        raise ArithmeticError("that is enough.")

    monkeypatch.setattr(sys.modules["estimators.diagnosis.diagnose"], "setting_of", setting_of)
    with pytest.raises(ArithmeticError, match="that is enough"):
        est.diagnose(fit_of_nothing, more, progress=False)
    assert seen == [recording.names]
    with pytest.raises(ValueError, match="this recording holds none of these"):
        est.diagnose(fit_of_nothing, dataclasses.replace(recording, experiments=(other,)), progress=False)


def test_no_candidate_left_is_refused(recordings: dict[str, rtac.Recording], fit_of_nothing: est.Fit) -> None:
    with pytest.raises(ValueError, match="no candidate is left"):
        est.diagnose(fit_of_nothing, recordings["nothing"], candidates=[rtac.effects.CartViscous], progress=False)


@pytest.mark.slow
@pytest.mark.parametrize("draw", range(3))
def test_coloured_noise_without_a_rest_record_is_no_effect(draw: int) -> None:
    rig = dataclasses.replace(virtual_rig.Rig().drawn(150 + draw), noise_correlation=0.9)
    plans = virtual_rig.standard_plans(
        seed=250 + draw, sample_time=0.005, duration=6.0, free=2, forced=4, rest=0, repeats=1
    )
    found = diagnosed(virtual_rig.record(rig, plans, seed=350 + draw))
    assert found.verdict == "adequate", found


@pytest.mark.slow
@pytest.mark.parametrize("whole", [False, True], ids=["short", "whole"])
@pytest.mark.parametrize("name", PAPERS_OWN)
def test_an_effect_of_the_paper_is_named_where_the_model_lacks_it(
    recordings: dict[str, rtac.Recording], name: str, whole: bool
) -> None:
    recording = recordings["nothing"]
    model = rtac.RTAC.from_rig(recording).without(name)
    offered = None if whole else [*SHORT, *(CATALOGUE[one] for one in PAPERS_OWN)]
    fit = est.output_error(model, recording, progress=False)
    found = est.diagnose(fit, recording, candidates=offered, progress=False)
    assert found.verdict == "missing", found
    assert [c.id for c in found.effects] == [name], found


@pytest.mark.slow
@pytest.mark.parametrize(("push", "said"), [(4.0, True), (0.6, False)], ids=["one end", "both ends"])
def test_of_a_stop_that_one_end_of_the_travel_shows_it_is_said_that_the_other_is_assumed(
    push: float, said: bool
) -> None:
    """A constant force on the cart moves its rest so far that it does not come to the other end."""
    plans = [
        virtual_rig.Plan(
            f"pushed_{n}", "forced", 3.0, initial_position=at, disturbance_force=np.full(600, push), initial_angle=0.0
        )
        for n, at in enumerate((0.0115, 0.0108))
    ]
    recording = virtual_rig.record(virtual_rig.Rig(end_stop_travel=0.009), plans, seed=3)
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    found = est.diagnose(fit, recording, candidates=[CATALOGUE["end_stop"]], thorough=False, progress=False)
    assert [effect.id for effect in found.effects] == ["end_stop"]
    assert ("end_stop was touched at positive positions only" in found.explanation) == said
    assert ("end_stop was touched" in found.explanation) == said
