"""The compiled local fits against those in NumPy, window by window."""

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from estimators.frequency_response.batched_local_polynomial import local_responses
from estimators.frequency_response.local_polynomial import VanishingError, one_by_one
from rtac_jax.measurement import Experiment, Recording


def spectra(samples, seed, lines):
    """A resonance under white noise, with its transient."""
    random = np.random.default_rng(seed)
    current = random.standard_normal(samples)
    decay = np.exp(-0.02 * np.arange(400)) * np.sin(0.2 * np.arange(400))
    out = np.convolve(current, decay)[:samples] + 0.1 * random.standard_normal(samples)
    return np.fft.rfft(current), np.fft.rfft(out), lines


THREE = [
    spectra(800, 1, np.arange(5.0, 120.0)), spectra(811, 2, np.linspace(3.3, 90.7, 40)), spectra(1500, 3, np.arange(1.0, 30.0))
]  # fmt: skip


@pytest.mark.parametrize(("degree", "poles"), [(2, 2), (1, 0)])
def test_compiled_fits_of_all_conditions_are_those_of_numpy(degree, poles):
    options = {"half_width": 12, "degree": degree, "poles": poles}
    for found, expected in zip(local_responses(THREE, **options), one_by_one(THREE, **options), strict=True):
        assert found.freedom == expected.freedom
        for part in ("response", "std", "noise"):
            value, known = getattr(found, part), getattr(expected, part)
            assert np.max(np.abs(value / known - 1)) < 1e-10, part


def test_a_condition_whose_input_vanishes_has_its_error_and_the_others_their_fits():
    into, out, lines = THREE[0]
    silent = np.where((np.arange(len(into)) > 40) & (np.arange(len(into)) < 100), 0.0, into)
    both = [THREE[1], (silent, out, lines)]
    for fitted in (local_responses(both, half_width=12), one_by_one(both, half_width=12)):
        assert not isinstance(fitted[0], VanishingError)
        assert isinstance(fitted[1], VanishingError)
        assert fitted[1].line == 41.0 + 12.0  # the first whose whole window is silent


def test_many_conditions_are_estimated_by_the_compiled_program():
    """From as many lines on as NumPy takes longer for, with the same result as one by one."""
    rtac.configure()
    random = np.random.default_rng(4)
    runs = []
    for n in range(6):
        current = random.standard_normal(600)
        out = np.convolve(current, np.exp(-0.05 * np.arange(200)))[:600] + 0.05 * random.standard_normal(600)
        runs.append(Experiment.of(f"run_{n}", kind="forced", sample_time=0.02, current=current, cart_position=out))
    together = est.frequency_responses(Recording(tuple(runs)), compensate=False, band=(0.5, 10.0))
    assert len(together.frequency) * len(runs) > 500
    for run in runs:
        alone = est.frequency_responses(Recording((run,)), compensate=False, band=(0.5, 10.0))
        assert np.max(np.abs(together[run.name].response / alone[0].response - 1)) < 1e-10
        assert np.max(np.abs(together[run.name].std / alone[0].std - 1)) < 1e-10
