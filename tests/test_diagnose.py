"""Hidden effects, made by the independent virtual rig, are named; with nothing hidden nothing is."""

import dataclasses

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from rtac_jax import virtual_rig

# What the rig hides, and which parameter of the model's effect should come out at which value.
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
}
CASES = list(HIDDEN)


@pytest.fixture(scope="module")
def recordings() -> dict[str, rtac.Recording]:
    """One recording for each hidden effect and one with none, all of one shape, on rigs drawn around the paper's."""
    jobs = []
    for number, name in enumerate([*CASES, "nothing"]):
        rig = virtual_rig.Rig().drawn(100 + number)
        hidden = HIDDEN[name][0] if name in HIDDEN else {}
        plans = virtual_rig.standard_plans(seed=200 + number, sample_time=0.005, duration=6.0, free=2, forced=4, rest=1)
        jobs.append((dataclasses.replace(rig, **hidden), plans, 300 + number))
    return dict(zip([*CASES, "nothing"], virtual_rig.record_many(jobs), strict=True))


def diagnosed(recording: rtac.Recording) -> est.Diagnosis:
    model = rtac.RTAC.from_rig(recording)
    return est.diagnose(est.output_error(model, recording, progress=False), recording, progress=False)


@pytest.mark.parametrize("name", CASES)
def test_hidden_effect_is_named(recordings: dict[str, rtac.Recording], name: str) -> None:
    found = diagnosed(recordings[name])
    assert found.verdict == "missing", found
    assert [c.id for c in found.effects] == [name], found
    assert found.effects[0].error_reduction > 0.9
    estimates = found.effects[0].parameters
    for parameter, truth in HIDDEN[name][1].items():
        estimate = estimates[parameter]
        assert estimate.value == pytest.approx(truth, abs=5 * estimate.std + 0.02 * abs(truth)), (parameter, estimate)
    assert found.best is not None
    assert found.best.id == name


def test_nothing_hidden_is_adequate(recordings: dict[str, rtac.Recording]) -> None:
    found = diagnosed(recordings["nothing"])
    assert found.verdict == "adequate", found
    assert found.best is None
    assert found.effects == ()
    assert all(np.isfinite(c.detection_limit) for c in found.candidates if c.testable)


def test_no_candidate_left_is_refused(recordings: dict[str, rtac.Recording]) -> None:
    recording = recordings["nothing"]
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False, starts=1)
    with pytest.raises(ValueError, match="no candidate is left"):
        est.diagnose(fit, recording, candidates=[rtac.effects.CartViscous], progress=False)
