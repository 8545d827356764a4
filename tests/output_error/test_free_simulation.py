"""The free simulation of a model beside what was measured: what it leaves, and what counts as following."""

import dataclasses

import numpy as np
import pytest
from exact_decay import MASS, STIFFNESS, VISCOUS, exact_decay

import rtac_jax as rtac
from estimators.core.data import CHANNELS, Data, in_channels
from estimators.core.initial_state import space_of
from estimators.output_error.free_simulation import FreeSimulation

NOISE = 5e-5
POSITION = CHANNELS.index("cart_position")


@pytest.fixture(scope="module")
def simulation():
    """Of two decays in closed form, with noise, from where they begin and by the model that they obey."""
    begins, random = {"high": 0.012, "low": 0.004}, np.random.default_rng(4)
    several = [
        rtac.Experiment.of(
            name, kind="free", sample_time=0.02, arm="locked", initial_arm_angle=0.0, noise_std={"cart_position": NOISE},
            cart_position=exact_decay(begin, 0.02 * np.arange(150)) + NOISE * random.standard_normal(150),
        )
        for name, begin in begins.items()
    ]  # fmt: skip
    recording = rtac.Recording(several, rig={"total_mass": MASS})
    model = rtac.RTAC.from_rig(recording).without("cart_coulomb")
    model = model.with_values({"spring_stiffness": STIFFNESS, "cart_viscous.coefficient": VISCOUS})
    start = {name: np.array([begin, 0.0, 0.0, 0.0]) for name, begin in begins.items()}
    space = space_of(model, several, free=[], start=start)
    return FreeSimulation(model, Data.of(several), space, in_channels({"cart_position": NOISE}), substeps=4)


def test_what_the_true_model_leaves_is_the_noise(simulation):
    unknowns = simulation.space.unconstrained()
    assert simulation.rms(simulation.error(unknowns))[POSITION] == pytest.approx(NOISE, rel=0.1)
    assert not simulation.loses(unknowns, 1e-3)


def test_one_channel_of_one_experiment_that_is_not_followed_is_enough(simulation):
    """However well all others are; less than is left counts only where noise could be as much."""
    values = np.array(simulation.data.values)
    values[:, POSITION, -1] *= -1.0
    turned = dataclasses.replace(simulation, data=dataclasses.replace(simulation.data, values=values))
    unknowns = simulation.space.unconstrained()
    assert turned.loses(unknowns, 0.25)
    assert not turned.loses(unknowns, 2.5), "what a turned sign leaves is twice the motion"
    assert not dataclasses.replace(turned, noise=np.full(len(CHANNELS), 0.1)).loses(unknowns, 0.25)


def test_no_channel_is_trusted_beyond_its_sensor(simulation):
    """One that nobody measured is as far off as its noise; one that happens to fit all but is."""
    error = np.zeros(simulation.data.values.shape)
    assert np.array_equal(simulation.rms(error), simulation.noise)
    error[3, POSITION, 0] = 1e-30
    assert simulation.rms(error)[POSITION] == pytest.approx(1e-12 * NOISE)
    error[3, POSITION, 0] = 3.0
    assert simulation.rms(error)[POSITION] == pytest.approx(3.0 / np.sqrt(300))
