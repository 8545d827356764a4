"""Fits of anything a recording may hold: a result, or a refusal in a sentence. One structure and one shape, compiled once."""

import numpy as np
import pytest
from fuzz import fuzz, outcome, sizes
from hypothesis import strategies as st

import estimators as est
import rtac_jax as rtac
from rtac_jax import RTAC
from rtac_jax.measurement import Experiment, Recording, concerns

ROOM = 48  # samples: all lengths up to here run the same compiled code
STEP = 2e-2
TIME = STEP * np.arange(ROOM)
SIZES = st.one_of(st.just(1.0), st.sampled_from([-1.0, 1e-3, 1e3, 57.3, 1e-12, 1e12, 1e-300, 1e100]))
CONSTANTS = st.one_of(st.just(1.0), st.sampled_from([1e-3, 1e3, 1e-9, 1e9, 1e-14, 1e14, 1e-200, 1e200]))
GAPS = st.lists(st.integers(0, ROOM - 1), max_size=6)
RIG = {"total_mass": 1.23, "arm_inertia": 9.5e-5}


def simulated():
    """Two experiments of the paper's rig, by the model itself: it is not the truth that is tried here."""
    given = {"kind": "forced", "sample_time": STEP, "current": 0.5 * np.sin(8 * TIME), "initial_arm_angle": 0.3}
    plans = [Experiment.of(name, cart_position=TIME, **given) for name in ("forced_1", "forced_2")]
    starts = {"forced_1": np.array([5e-3, 0, 0.3, 0]), "forced_2": np.array([-8e-3, 0.05, 0.3, 5])}
    found = rtac.simulate(RTAC.paper(), plans, start=starts, substeps=4)
    noise = np.random.default_rng(0).standard_normal((2, 2, ROOM))
    return {
        name: (one.cart_position + 1e-5 * noise[k, 0], one.arm_velocity + 1e-2 * noise[k, 1])
        for k, (name, one) in enumerate(found.items())
    }


@pytest.fixture(scope="module")
def measured():
    return simulated()


FAULTS = ("sample time", "length", "size", "offset", "gaps", "current", "noise", "constants")


@st.composite
def recordings(draw, measured):
    """Measurements with up to two faults: with one of every kind hardly any recording could be fitted."""
    faults = draw(st.sets(st.sampled_from(FAULTS), max_size=2))

    def either(fault, strategy, sound):
        return draw(strategy) if fault in faults else sound

    experiments = []
    sample_time = either("sample time", st.sampled_from([2e-5, 20.0, 1e-12, 1e6]), STEP)
    for name, signals in measured.items():
        length = either("length", st.integers(8, ROOM), ROOM)
        channels = {}
        for channel, values in zip(("cart_position", "arm_velocity"), signals, strict=True):
            changed = either("size", SIZES, 1.0) * values[:length] + either("offset", st.sampled_from([1.0, 1e6]), 0.0)
            changed[[gap for gap in either("gaps", GAPS, []) if gap < length]] = np.nan
            channels[channel] = changed
        current = either("current", SIZES, 1.0) * 0.5 * np.sin(8 * TIME[:length])
        known = {"cart_position": 1e-5, "arm_velocity": 1e-2}
        noise = either("noise", st.sampled_from([{}, {"cart_position": 1e-300}]), known)
        experiment = outcome(
            Experiment.of, name, kind="forced", sample_time=sample_time, current=current, initial_arm_angle=0.3,
            noise_std=noise, **channels,
        )  # fmt: skip
        if experiment is not None:
            experiments.append(experiment)
    rig = {name: value * either("constants", CONSTANTS, 1.0) for name, value in RIG.items()}
    return outcome(Recording, tuple(experiments), rig) if len(experiments) == 2 else None


def holds(fit):
    """A fit says how it ended and holds numbers, or says of them that it does not know them."""
    assert str(est.RESULTS[fit.result]).endswith(".")
    for name, parameter in fit.parameters.items():
        assert np.isfinite(parameter.value), name
    assert all(np.isfinite(states).all() for states in fit.start.values())


@sizes(40, 400)
def test_closed_forms_and_simulations_of_anything(trials, measured):
    @fuzz(trials, recording=recordings(measured), weak=st.booleans())
    def trial(recording, weak):
        if recording is None:
            return
        assert all(sentence.endswith(".") for sentence in concerns(recording))
        model = outcome(RTAC.from_rig, recording)
        if model is None:
            return
        found = outcome(est.least_squares, model, recording, weak=weak)
        if found is not None:
            outcome(rtac.simulate, found.model, recording, substeps=4)

    trial()


@sizes(5, 120)
def test_fits_of_anything(trials, measured):
    ended = []

    @fuzz(trials, recording=recordings(measured))
    def trial(recording):
        model = None if recording is None else outcome(RTAC.from_rig, recording)
        if model is None:
            return
        fit = outcome(est.output_error, model, recording, starts=1, steps=10, progress=False)
        if fit is not None:
            holds(fit)
            ended.append(fit)

    trial()
    assert ended  # or refusals alone would have been tried


def test_the_recording_that_is_spoilt_is_fitted_when_it_is_not(measured):
    given = {"kind": "forced", "sample_time": STEP, "current": 0.5 * np.sin(8 * TIME), "initial_arm_angle": 0.3}
    experiments = [
        Experiment.of(name, cart_position=x, arm_velocity=w, noise_std={"cart_position": 1e-5, "arm_velocity": 1e-2}, **given)
        for name, (x, w) in measured.items()
    ]  # fmt: skip
    recording = Recording(tuple(experiments), RIG)
    fit = est.output_error(RTAC.from_rig(recording), recording, starts=1, progress=False)
    holds(fit)
    assert fit.parameters["spring_stiffness"].value == pytest.approx(132.6, rel=0.05)
