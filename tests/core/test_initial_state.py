"""The states at the start, as the first samples show them."""

import dataclasses

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from estimators.core.initial_state import first_values, scales_of, space_of
from rtac_jax import virtual_rig
from rtac_jax.effects import ArmCoulomb
from rtac_jax.measurement import Signal

NOISE = 1e-3


@pytest.mark.parametrize("fast", [0.0, 0.1])
def test_a_slow_swing_does_not_hide_what_moves_fast_beside_it(fast: float) -> None:
    """Of an arm that swings slowly and far, with a fast movement upon that, or none."""
    time = 0.002 * np.arange(4000)
    angle = 2.0 * np.sin(1.5 * time) + fast * np.sin(40.0 * time)
    signal = Signal(angle + NOISE * np.random.default_rng(1).standard_normal(len(time)), "rad")
    value, slope = first_values(signal, 0.002, 1.5 / (2 * np.pi))
    assert value == pytest.approx(0.0, abs=4 * NOISE)
    assert slope == pytest.approx(3.0 + 40.0 * fast, abs=1.0 if fast else 0.1)


@pytest.mark.parametrize("encoder", [pytest.param(False, marks=pytest.mark.slow), True])
def test_the_start_is_within_what_the_prior_allows(encoder: bool) -> None:
    """Of sixteen rigs, played differently; the true start is that of the plan."""
    jobs = []
    for number in range(16):
        plans = virtual_rig.standard_plans(seed=number, sample_time=0.002, duration=2.0, free=1, forced=2, rest=0)
        rig = virtual_rig.Rig(encoder=encoder, arm_coulomb=1e-3 * (number % 3)).drawn(40 + number)
        jobs.append((rig, plans, 80 + number))
    apart = []
    for recording, (_, plans, _) in zip(virtual_rig.record_many(jobs), jobs, strict=True):
        shown = [
            dataclasses.replace(
                e, outputs={c: s for c, s in e.outputs.items() if not (encoder and c == "arm_velocity")}
            )
            for e in recording.experiments
        ]
        space = space_of(rtac.RTAC.from_rig(recording), shown, free=[])
        truth = np.array([plan.start for plan in plans]).T
        apart.append((np.asarray(space.start) - truth) / np.asarray(space.start_scale))
    assert np.max(np.abs(apart)) < 3.0
    assert np.all(np.sqrt(np.mean(np.square(apart), axis=(0, 2))) < 1.0)


def test_a_constant_has_a_start() -> None:
    for values in (np.full(5, 0.3), np.full(50, 0.3)):
        value, slope = first_values(Signal(values, "m"), 0.01, 1.0)
        assert value == pytest.approx(0.3)
        assert slope == pytest.approx(0.0, abs=1e-9)


@pytest.mark.slow
def test_an_arm_at_rest_that_only_an_encoder_shows_begins_at_rest() -> None:
    """The innovations of the first samples are noise, too, where dry friction holds the arm at first."""
    plans = virtual_rig.standard_plans(
        seed=9, sample_time=0.002, duration=3.0, free=0, forced=2, rest=0, current_rms=0.1
    )
    clamped = [dataclasses.replace(p, cart="clamped", initial_position=0.0, initial_velocity=0.0) for p in plans]
    rig = virtual_rig.Rig(arm_coulomb=2e-3, encoder=True)
    whole = virtual_rig.record(rig, clamped, seed=3)
    shown = [dataclasses.replace(e, outputs={"arm_angle": e.outputs["arm_angle"]}) for e in whole.experiments]
    recording = dataclasses.replace(whole, experiments=tuple(shown))
    model = rtac.RTAC.from_rig(recording) + ArmCoulomb(1.5e-3)
    found = est.prediction_error_nonlinear(model, recording, progress=False)
    level = found.parameters["arm_coulomb.level"]
    assert level.value == pytest.approx(2e-3, abs=4 * level.std)
    assert level.std < 2e-6
    assert found.statistics["one_step_rms"]["arm_angle"] < 1.2 * rig.angle_noise
    assert "white" in found.verdict


def test_forces_of_a_cart_without_spring_are_those_that_move_it() -> None:
    """What a diagnosis looks for is a fraction of them: of a spring that is not there it would look for nothing."""
    time = 0.01 * np.arange(400)
    push = 50.0 * np.sin(2.0 * np.pi * time)
    driven = rtac.Experiment.of(
        "driven", kind="forced", sample_time=0.01, arm="locked", cart_position=0.1 * np.sin(2.0 * np.pi * time),
        disturbance_force=push,
    )  # fmt: skip
    model = rtac.RTAC.paper().with_values({"spring_stiffness": 0.0, "total_mass": 10.0})
    assert scales_of(model, [driven]).force == pytest.approx(50.0 / 2**0.5, rel=1e-6)
    stiff = model.with_values({"spring_stiffness": 1e4})
    assert scales_of(stiff, [driven]).force == pytest.approx(1e3 / 2**0.5, rel=1e-3)
