"""The band of a frequency response: where the input has energy by default, in Hz, and within half of the sampling rate."""

import numpy as np
import pytest
import scipy.signal

import estimators as est
import rtac_jax as rtac
from rtac_jax.measurement import Experiment, Recording


@pytest.fixture(scope="module")
def recording() -> Recording:
    """A second-order plant under filtered noise, whose single lines stick out up to half of the sampling rate."""
    rtac.configure()
    random = np.random.default_rng(1)
    played = scipy.signal.lfilter(*scipy.signal.butter(3, 0.1), random.normal(size=2000))
    states = scipy.signal.cont2discrete(scipy.signal.tf2ss([1.0], [1.0, 1.0, 100.0]), 0.02)[:4]
    _, position, _ = scipy.signal.dlsim((*states, 0.02), played)
    one = Experiment.of(
        "noise", kind="forced", sample_time=0.02, current=played, initial_arm_angle=0.0,
        cart_position=position[:, 0] + 1e-6 * random.normal(size=2000),
    )  # fmt: skip
    return Recording((one,), {})


def test_the_default_band_ends_where_noise_does(recording: Recording) -> None:
    (found,) = est.frequency_responses(recording, compensate=False)
    truth = 1 / (100 - found.frequency**2 + 1j * found.frequency)
    inside = found.frequency < 2 * np.pi * 2.0
    assert np.sum(inside) > 50
    assert np.median(np.abs(found.response - truth)[inside] / np.abs(truth)[inside]) < 0.01
    assert found.frequency[-1] < 2 * np.pi * 25


def test_rad_per_second_in_the_place_of_hertz_is_refused(recording: Recording) -> None:
    with pytest.raises(ValueError, match=r"band: is 2 to 50 Hz, and half of the .* of noise is 25 Hz; give Hz"):
        est.frequency_responses(recording, compensate=False, band=(2.0, 50.0))
