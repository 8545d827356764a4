"""Predictions, which are mended at every sample, need fewer steps of integration than a simulation, and no fewer than they need."""

import jax.numpy as jnp
import numpy as np
import pytest

import rtac_jax as rtac
from estimators.core.data import CHANNELS, Data, moving
from estimators.core.deadline import Deadline, OutOfTimeError
from estimators.core.initial_state import scales_of, space_of
from estimators.core.sensor_noise import noise_levels
from estimators.core.step_size import STEP_ERROR, accurate_substeps
from estimators.prediction_error.filter_pass import run_filter
from estimators.prediction_error.noise_estimation import first_noise, fit_noise, low_process_noise
from estimators.prediction_error.noise_model import NoiseModel
from estimators.prediction_error.predictive_steps import predictive_substeps


@pytest.fixture(scope="module")
def problem():
    """A decay of ten seconds by its formula, sampled five times in a radian, beside an encoder of a tenth of a micrometre."""
    time = 0.02 * np.arange(500)
    mass, spring, viscous = 1.23, 132.6, 0.5543  # paper, section 4.2
    damping = viscous / (2 * mass)
    angular = np.sqrt(spring / mass - damping**2)
    decay = 0.015 * np.exp(-damping * time) * (np.cos(angular * time) + damping / angular * np.sin(angular * time))
    one = rtac.Experiment.of(
        "free", kind="free", sample_time=0.02, arm="locked", cart_position=1e-7 * np.round(decay / 1e-7)
    )
    recording = rtac.Recording([one])
    model = rtac.RTAC.paper().without("cart_coulomb").with_values({"total_mass": mass, "spring_stiffness": spring})
    model = model.with_values({"cart_viscous.coefficient": viscous}).fix("total_mass")
    experiments = moving(recording)
    levels = noise_levels(recording.experiments)
    space = space_of(model, experiments, free=model.free)
    prior = NoiseModel.of(levels, recording.experiments, scales_of(model, experiments), space)
    return model, Data.of(experiments), space, prior, np.array([levels.get(channel, 1.0) for channel in CHANNELS])


def test_predictions_need_fewer_than_a_simulation_and_their_innovations_are_those_of_far_shorter_steps(problem):
    model, data, space, prior, noise = problem
    physical = (space.values, space.each_values, space.start)
    simulated = accurate_substeps(model, data, space, space.unconstrained(), noise)
    found = predictive_substeps(model, data, space, physical, prior)
    assert found < simulated

    def innovations(substeps):
        at = low_process_noise(first_noise())
        return np.asarray(run_filter(model, data, space, physical, prior, at, jnp.asarray(substeps)).innovations)

    apart = innovations(found) - innovations(32)
    count = np.asarray(data.present).sum(axis=(0, 2))
    rms = np.sqrt((apart**2).sum(axis=(0, 2)) / np.maximum(count, 1))
    assert np.all(rms < 1.2 * STEP_ERROR)  # what each further halving changes is a sixteenth of the one before


def test_no_more_are_taken_than_a_simulation_needs(problem):
    model, data, space, prior, _ = problem
    physical = (space.values, space.each_values, space.start)
    assert predictive_substeps(model, data, space, physical, prior, most=1) == 1


def test_a_fit_of_the_noise_looks_at_the_time(problem):
    model, data, space, prior, _ = problem
    physical = (space.values, space.each_values, space.start)
    with Deadline(0.0).kept(), pytest.raises(OutOfTimeError):
        fit_noise(model, data, space, physical, prior, None, jnp.asarray(1))
