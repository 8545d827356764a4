"""A model beside measurements: what its residuals say, and where its simulation begins."""

import dataclasses

import control
import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from estimators._compare import Trace
from rtac_jax import virtual_rig

STIFFNESS, DAMPING, ROTOR = 0.3, 2e-5, 0.3  # of a soft shaft; the last is what the motor has of the arm's inertia


def test_residual_statistics_of_a_trace() -> None:
    random = np.random.default_rng(2)
    time = 0.01 * np.arange(2000)
    clean = np.sin(time)
    white = Trace("a", "cart_position", time, clean + 0.1 * random.normal(size=2000), clean, clean, time >= 0, 0.1)
    assert white.rms == pytest.approx(0.1, rel=0.1)
    assert white.fit_percent == pytest.approx(100 * (1 - white.rms / np.std(white.measured)), rel=1e-9)
    assert white.whiteness_p > 0.01
    assert np.mean(np.abs(white.autocorrelation()[0][1:]) < white.autocorrelation()[1]) > 0.9
    coloured = control.forced_response(control.tf([1], [0.05, 1]), time, random.normal(size=2000)).outputs
    stained = Trace("a", "cart_position", time, clean + coloured, clean, clean, time >= 0, 0.1)
    assert stained.whiteness_p < 1e-6


def test_a_simulation_begins_at_a_speed_of_the_arm_that_no_sample_shows() -> None:
    """The tachometer sits on the rotor, which swings by radians per second about an arm behind a soft shaft."""
    rig = dataclasses.replace(virtual_rig.Rig(), shaft_stiffness=STIFFNESS, shaft_damping=DAMPING, rotor_share=ROTOR)
    plans = virtual_rig.standard_plans(seed=3, sample_time=0.002, duration=5.0, free=0, forced=4, rest=1)
    recording = virtual_rig.record(rig, plans, seed=4)
    twist = np.sqrt(STIFFNESS / (rig.arm_inertia * ROTOR * (1 - ROTOR)))
    damping = 0.5 * DAMPING * twist / STIFFNESS
    shaft = rtac.effects.FlexibleShaft(rig.arm_inertia / STIFFNESS, ROTOR, damping, 0.9 / 0.002)
    for trace in est.compare(rtac.RTAC.paper() + shaft, recording).models[0].traces:
        assert trace.rms < 1.2 * trace.noise, (trace.experiment, trace.channel)
