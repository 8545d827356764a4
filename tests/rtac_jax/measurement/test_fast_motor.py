"""A motor that turns by more than half a turn from one sample to the next."""

import numpy as np
import pytest

import rtac_jax as rtac
from rtac_jax.measurement import concerns, contradictions


@pytest.mark.parametrize(("cart", "contradicts"), [("clamped", False), ("free", True)])
def test_a_fast_motor_that_is_sampled_slowly_is_asked_about_and_contradicts_nothing(cart, contradicts) -> None:
    """At 60 rad/s and 0.5 s a sample "sample_time is likely in ms" was said, and to be mended first."""
    speed = 60.0 * np.sin(0.05 * np.arange(128))
    extra = {} if cart == "clamped" else {"cart_position": 0.01 * np.sin(0.3 * np.arange(128))}
    motor = rtac.Experiment.of("ramp", kind="free", sample_time=0.53, cart=cart, arm_velocity=speed, **extra)
    recording = rtac.Recording((motor,))
    said = [sentence for sentence in concerns(recording) if "more than half a turn from one sample" in sentence]
    assert len(said) == 1
    assert ("a fast motor that is sampled slowly" in said[0]) is not contradicts
    assert bool([s for s in contradictions(recording) if "half a turn" in s]) is contradicts


@pytest.mark.parametrize(("scale", "said"), [(180 / np.pi, True), (1.0, False)])
def test_an_encoder_alone_in_degrees_is_asked_about(scale: float, said: bool) -> None:
    """Nothing else shows its scale: a torque constant of 1.146 instead of 0.02 was "adequate", without a word."""
    angle = scale * np.cumsum(0.1 * np.sin(0.05 * np.arange(400)))
    motor = rtac.Experiment.of("run", kind="free", sample_time=0.01, cart="clamped", arm_angle=angle)
    found = [one for one in concerns(rtac.Recording((motor,))) if "it may be in degrees" in one]
    assert len(found) == said
    faulty = np.where(np.arange(400) == 200, angle + 50.0, angle)
    one = rtac.Experiment.of("run", kind="free", sample_time=0.01, cart="clamped", arm_angle=faulty)
    assert len([s for s in concerns(rtac.Recording((one,))) if "it may be in degrees" in s]) == said, "a fault is none"
