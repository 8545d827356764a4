"""The noise that is read off a spectrum, also where samples are missing."""

import numpy as np
import pytest

from estimators.core.sensor_noise import spectral_floor

MISSING = {
    "none": lambda index, random: index < 0,
    "three tenths at random": lambda index, random: random.random(len(index)) < 0.3,
    "six tenths at random": lambda index, random: random.random(len(index)) < 0.6,
    "one stretch": lambda index, random: (index > 700) & (index < 1000),
    "every third": lambda index, random: index % 3 == 1,
    "all but every fourth": lambda index, random: index % 4 != 0,
}


@pytest.mark.parametrize("which", MISSING)
def test_missing_samples_take_no_noise_away(which) -> None:
    """The lowest of several bands lies a little below the noise, in a short record more: no further with samples missing."""
    random = np.random.default_rng(3)
    index = np.arange(1500)
    found = []
    for draw in range(20):
        motion = 30 * np.sin(0.05 * index + draw) * np.exp(-index / 1500)
        values = motion + random.standard_normal(1500)
        values[MISSING[which](index, random)] = np.nan
        found.append(spectral_floor(values))
    assert np.mean(found) == pytest.approx(0.9, abs=0.08)
    assert np.std(found) < 0.15


def test_few_samples_far_apart_have_a_level_too() -> None:
    values = np.full(100, np.nan)
    values[::20] = [0.0, 1.0, 0.5, 1.5, 0.2]
    assert np.isfinite(spectral_floor(values))
