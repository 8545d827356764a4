"""The force missing from the equations of motion as a curve: of motors with a brake that is in no catalogue."""

import dataclasses

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from estimators.core.data import moving
from estimators.core.sensor_noise import noise_levels
from estimators.diagnosis.missing_force import significant_equation_curves
from estimators.misspecification.equation_curves import equation_curves

INERTIA, CONSTANT, VISCOUS = 1e-3, 0.02, 3e-4
BRAKE, SPEED = 5e-3, 12.0  # an eddy-current brake: its torque falls again beyond this speed
COUNT, STEPS = 2 * np.pi / 4096, 20


def acceleration(drive: float, speed: float, brake: float) -> float:
    return (drive - VISCOUS * speed - brake * speed / (1 + (speed / SPEED) ** 2)) / INERTIA


def motor(brake: float, amplitudes=(5.0, 3.0, 8.0), seed=3) -> rtac.Recording:
    """Return runs of a motor whose encoder alone is read, driven by a few sines that are held between the samples."""
    random, dt = np.random.default_rng(seed), 0.005
    time = dt * np.arange(1000)
    runs = []
    for number, amplitude in enumerate(amplitudes):
        lines = [(f, random.uniform(0, 2 * np.pi)) for f in np.linspace(0.2, 6.0, 12)]
        wave = sum(np.sin(2 * np.pi * f * time + phase) for f, phase in lines)
        current = amplitude * wave / np.std(wave)

        angles, angle, speed, step = [], 0.0, 0.0, dt / STEPS
        for drive in CONSTANT * current:
            angles.append(angle)
            for _ in range(STEPS):  # the middle of a step by half of it: of second order, and nothing of the package's
                middle = speed + 0.5 * step * acceleration(drive, speed, brake)
                angle += step * middle
                speed += step * acceleration(drive, middle, brake)
        runs.append(
            rtac.Experiment.of(
                f"run_{number}",
                kind="forced",
                sample_time=dt,
                cart="clamped",
                current=current,
                intersample="zoh",
                arm_angle=COUNT * np.round(np.array(angles) / COUNT),
                initial_arm_angle=0.0,
                noise_std={"arm_angle": COUNT / np.sqrt(12)},
            )
        )
    return rtac.Recording(runs, rig={"arm_inertia": INERTIA})


@pytest.fixture(scope="module")
def braked() -> rtac.Recording:
    return motor(BRAKE)


def of(recording: rtac.Recording) -> list:
    experiments = moving(recording)
    return equation_curves(rtac.RTAC.from_rig(recording), experiments, noise_levels(experiments))


def test_a_brake_that_is_in_no_catalogue_is_read_off_the_equations(braked):
    """Its torque against the speed, and the law of it, beside a viscous friction that would take the best part of it."""
    best, *others = of(braked)
    assert (best.curve.port, best.curve.variable) == ("arm", "arm_velocity")
    assert best.fraction > 0.9
    assert all(best.curve.score > 10 * one.curve.score for one in others)
    law = best.curve.formulas(most=1)[0]
    assert law.effect.id == "law_of_arm_velocity_peak"
    coefficient, shape = law.parameters["coefficient_1"], law.parameters["shape_1"]
    assert coefficient.value == pytest.approx(-BRAKE, rel=0.05)
    assert shape.value == pytest.approx(SPEED, rel=0.1)
    assert best.values["torque_constant"] == pytest.approx(CONSTANT, rel=0.01)


def test_of_a_motor_that_hides_nothing_no_curve_is_more_than_chance():
    recording = motor(0.0, amplitudes=(5.0, 3.0))
    model = rtac.RTAC.from_rig(recording)
    assert not significant_equation_curves(model, recording)
    assert significant_equation_curves(
        rtac.RTAC.from_rig(motor(BRAKE, amplitudes=(5.0, 3.0))), motor(BRAKE, amplitudes=(5.0, 3.0))
    )


def test_what_explains_less_than_most_does_not_stand_alone(braked):
    model = rtac.RTAC.from_rig(braked)
    assert significant_equation_curves(model, braked, alone=True)[0].curve.variable == "arm_velocity"
    strict = dataclasses.replace(est.DiagnosisPolicy(), static=0.9999)
    assert significant_equation_curves(model, braked, strict)
    assert not significant_equation_curves(model, braked, strict, alone=True)


def test_a_few_samples_tell_no_curve(braked):
    short = rtac.Recording([e.cut(0, 60, e.name) for e in braked.experiments], rig=braked.rig)
    assert of(short) == []


def test_curves_are_made_of_chance_as_seldom_as_is_stated():
    """Of 40 motors that hide nothing at most two, at the level of the tests; none was in 60."""
    several = [motor(0.0, amplitudes=(5.0, 3.0), seed=seed) for seed in range(40)]
    assert sum(bool(significant_equation_curves(rtac.RTAC.from_rig(one), one)) for one in several) <= 2
