"""Predictions several samples ahead lie between those one sample ahead and the free simulation."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from estimators.core.data import Data, moving
from estimators.core.initial_state import space_of
from estimators.core.residual import predict
from estimators.prediction_error.several_steps_ahead import predict_ahead
from rtac_jax import virtual_rig

LONG = 400  # samples, longer than any experiment here


@pytest.fixture(scope="module")
def shaken() -> tuple[rtac.Recording, rtac.RTAC]:
    """A rig whose arm random torques turn away from any simulation, and its own model."""
    rig = dataclasses.replace(virtual_rig.Rig(), torque_noise=3e-4, force_noise=3e-3)
    plans = virtual_rig.standard_plans(seed=3, sample_time=0.01, duration=3.0, free=1, forced=1, rest=1)
    recording = virtual_rig.record(rig, plans, seed=4)
    return recording, rtac.RTAC.from_rig(recording)


@pytest.fixture(scope="module")
def fit(shaken: tuple[rtac.Recording, rtac.RTAC]) -> est.PredictorFit:
    return est.prediction_error_nonlinear(shaken[1], shaken[0], from_model=True, progress=False)


def test_the_further_ahead_the_larger_the_error(
    shaken: tuple[rtac.Recording, rtac.RTAC], fit: est.PredictorFit
) -> None:
    recording, _ = shaken
    by_horizon = {k: est.compare(fit, recording, ahead=k) for k in (1, 10, 50)}
    errors = {k: found.models[0].errors for k, found in by_horizon.items()}
    for channel in ("cart_position", "arm_velocity"):
        one, ten, fifty = (errors[k][channel].rms for k in (1, 10, 50))
        assert one < ten < fifty, channel
    assert errors[1]["cart_position"].rms == pytest.approx(fit.criteria.rms["cart_position"], rel=0.1)
    assert str(by_horizon[10]).startswith(
        "Predictions 10 samples ahead: their errors are correlated even where the model is right"
    )
    assert "white" not in str(by_horizon[10]).split("\n", 1)[1]
    assert str(by_horizon[1]).startswith("Predictions one sample ahead.\n")
    assert "white" in str(by_horizon[1])
    assert all(np.argmax(t.used) == 10 for t in by_horizon[10].models[0].traces)


def test_a_model_without_noise_of_its_own_gets_it_from_the_recording(
    shaken: tuple[rtac.Recording, rtac.RTAC], fit: est.PredictorFit
) -> None:
    recording, _ = shaken
    own, found = (est.compare(of, recording, ahead=5).models[0].errors for of in (fit, fit.model))
    for channel, error in own.items():
        assert found[channel].rms == pytest.approx(error.rms, rel=0.1)


def test_one_step_and_no_gain_are_what_they_should_be(shaken: tuple[rtac.Recording, rtac.RTAC]) -> None:
    """One step ahead is the time loop's own prediction; without a gain every horizon is the simulation."""
    recording, model = shaken
    experiments = moving(recording)
    space, data = space_of(model, experiments, free=[]), Data.of(experiments)
    physical = space.physical(space.unconstrained())
    into = np.zeros((len(model.states), 3))
    into[0, 0], into[1, 0], into[3, 1] = 0.3, 1.0, 0.5  # which tames the chaos of a tumbling arm
    gain = jnp.asarray(np.broadcast_to(into[None, :, :, None], (data.room, *into.shape, data.experiments)))
    steps = jnp.asarray(2)
    here = np.asarray(data.present) > 0
    one = predict_ahead(model, data, space, physical, gain, ahead=1, substeps=steps)
    known = predict(model, data, space, physical, substeps=steps, gain=gain)
    np.testing.assert_allclose(np.asarray(one)[here], np.asarray(known)[here], rtol=1e-7, atol=1e-9)
    free = predict(model, data, space, physical, substeps=steps)
    for ahead, gained in ((3, 0 * gain), (LONG, gain)):
        found = predict_ahead(model, data, space, physical, gained, ahead=ahead, substeps=steps)
        np.testing.assert_allclose(np.asarray(found)[here], np.asarray(free)[here], rtol=1e-7, atol=1e-9)


def test_a_horizon_that_is_none_is_refused(shaken: tuple[rtac.Recording, rtac.RTAC]) -> None:
    with pytest.raises(ValueError, match="ahead: is 0"):
        est.compare(shaken[1], shaken[0], ahead=0)


def late(experiment: rtac.Experiment, samples: int) -> rtac.Experiment:
    """Return an experiment whose sensors come on after so many samples."""
    outputs = {
        channel: dataclasses.replace(
            signal, values=np.where(np.arange(experiment.samples) < samples, np.nan, signal.values)
        )
        for channel, signal in experiment.outputs.items()
    }
    return dataclasses.replace(experiment, outputs=outputs)


def test_sensors_that_come_on_late_are_predicted_from_then_on() -> None:
    """An encoder shows where the arm is then, as of an experiment that begins there."""
    plans = virtual_rig.standard_plans(seed=3, sample_time=0.01, duration=3.0, free=1, forced=1, rest=0)
    recording = virtual_rig.record(virtual_rig.Rig(encoder=True), plans, seed=4)
    model = rtac.RTAC.from_rig(recording)
    whole = dataclasses.replace(recording, experiments=tuple(late(e, 50) for e in recording.experiments))
    cut = dataclasses.replace(recording, experiments=tuple(e.cut(50, e.samples, e.name) for e in recording.experiments))
    one, other = (est.compare(model, r, ahead=5).models[0] for r in (whole, cut))
    for of_whole, of_cut in zip(one.traces, other.traces, strict=True):
        assert np.argmax(of_whole.used) == 55
        np.testing.assert_allclose(
            of_whole.residual[of_whole.used], of_cut.residual[of_cut.used], rtol=1e-8, atol=1e-14
        )


def test_without_an_encoder_the_start_is_unsure_until_sensors_come_on(
    shaken: tuple[rtac.Recording, rtac.RTAC], fit: est.PredictorFit
) -> None:
    recording, _ = shaken
    whole = dataclasses.replace(
        recording, experiments=tuple(e if e.kind == "rest" else late(e, 50) for e in recording.experiments)
    )
    complete, found = (est.compare(fit, r, ahead=5).models[0].errors for r in (recording, whole))
    for channel, error in complete.items():
        assert found[channel].rms < 1.2 * error.rms
