"""Motors whose steps are mostly steady, of which the rows that move fit worst."""

import numpy as np

import estimators as est
from rtac_jax.measurement import Experiment, Recording


def test_motors_that_run_up_late_have_their_wires_right():
    """Steps of a motor that answers 59 ms late, at 50 ms a sample: what turns steadily outnumbers what moves."""
    time, several = 0.05 * np.arange(81), []
    noise = np.random.default_rng(5)
    for volts in (3.0, 6.0, 9.0, 12.0):
        since = np.maximum(time - 1.0592, 0.0)
        speed = 1.79 * volts / (1 + 0.009 * volts) * (1 - np.exp(-10.44 * since))
        read = np.floor(speed / 0.314 + noise.random(81)) * 0.314
        several.append(
            Experiment.of(
                f"step_{volts:.0f}", kind="forced", sample_time=0.05, cart="clamped", arm_velocity=read,
                current=np.where(time >= 0.999, volts, 0.0), initial_arm_angle=0.0,
            )
        )  # fmt: skip
    recording = Recording(several, {"arm_inertia": 1e-4})
    assert est.channel_consistency(recording).concerns == []
