"""Conditions of unequal lengths and sample times: each comes out as if it stood alone."""

import functools
from dataclasses import replace

import numpy as np
import pytest
from operating_conditions import RIG
from unequal_recordings import near

import estimators as est
from rtac_jax.measurement import Recording, from_rest, harmonic_grid, multisine
from rtac_jax.virtual_rig import Plan, record

BAND = (1.0, 4.0)  # [Hz]
GRID = 2 * np.pi * np.linspace(1.2, 3.8, 9)
# Samples and sample time [s] of small motions, without dry friction.
CONDITIONS = {"long": (1000, 0.02), "brief": (600, 0.02), "quick": (600, 0.01)}


@functools.cache
def recorded() -> Recording:
    plans = []
    for number, (name, (samples, sample_time)) in enumerate(CONDITIONS.items()):
        lines = [int(h) for h in harmonic_grid("all", period=samples, sample_time=sample_time, band=(1.0, 6.0))]
        wave = multisine(samples=samples, sample_time=sample_time, rms=0.01, harmonics=lines, seed=number)
        duration = samples * sample_time
        plans.append(Plan(name, "forced", duration, sample_time, from_rest(wave), initial_angle=0.3 * number))
    return record(replace(RIG, cart_coulomb=0.0), plans, seed=1, step=1e-3)


@pytest.mark.parametrize("options", [{"band": BAND}, {"frequency": GRID}])
def test_a_frequency_response_does_not_depend_on_the_other_conditions(options):
    together = est.frequency_responses(recorded(), method="local", **options)
    assert [one.name for one in together] == list(CONDITIONS)
    for one in together:
        alone = est.frequency_responses(recorded().select([one.name]), method="local", **options)[0]
        for name in ("frequency", "response", "std", "noise_std", "coherence", "arm_angle", "input_rms"):
            near(getattr(one, name), getattr(alone, name))


def test_realisations_of_other_lengths_are_refused_unless_one_grid_is_given():
    several = {"all": tuple(CONDITIONS)}
    with pytest.raises(ValueError, match="different lines"):
        est.frequency_responses(recorded(), method="local", band=BAND, realisations=several)
    found = est.frequency_responses(recorded(), method="local", frequency=GRID, realisations=several)
    near(found[0].frequency, GRID)


@pytest.mark.parametrize(
    ("structure", "name"),
    [
        ("output_error", "brief"),
        pytest.param("output_error", "quick", marks=pytest.mark.slow),
        pytest.param("box_jenkins", "brief", marks=pytest.mark.slow),
        pytest.param("box_jenkins", "quick", marks=pytest.mark.slow),
    ],
)
def test_a_linear_model_does_not_depend_on_the_other_conditions(structure, name):
    together = est.prediction_error(recorded(), structure=structure, progress=False)
    # Of one rig, whatever the samples: the natural frequency to within 1 % of each other.
    assert np.ptp([one.values[0] for one in together]) < 0.01 * together[0].values[0]
    assert np.all(np.isfinite(np.array([[r.response, r.std] for r in together.responses(GRID)])))
    alone = est.prediction_error(recorded().select([name]), structure=structure, progress=False)[0]
    one = together[name]
    assert one.converged
    assert (len(one.simulated), one.sample_time) == CONDITIONS[name]
    for what in ("values", "poles", "innovation_std", "bic", "noise_numerator", "simulated"):
        near(getattr(one, what), getattr(alone, what))
    near(one.std, alone.std, rtol=1e-6)
    near(one.residuals.autocorrelation, alone.residuals.autocorrelation, rtol=1e-6)
