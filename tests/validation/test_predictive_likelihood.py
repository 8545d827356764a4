"""Held-out experiments predicted one sample ahead tell models apart where random forces carry every simulation away."""

import dataclasses

import numpy as np
import pytest
import scipy.signal

import estimators as est
import rtac_jax as rtac
from estimators.core.data import Data
from estimators.diagnosis.model_extension import holding
from estimators.prediction_error.innovations import stretches
from estimators.validation import predictive_likelihood
from estimators.validation.predictive_likelihood import OneStepAhead, one_step_ahead
from rtac_jax import virtual_rig
from rtac_jax.effects import CubicSpring, EncoderGain

SHAKEN = {"force_noise": 1e-3, "torque_noise": 3e-5}
GAIN = 1.01


def recorded(**hidden: float) -> tuple[rtac.Recording, rtac.Recording]:
    """Two recordings of one shaken rig that also measures the arm's angle."""
    rig = dataclasses.replace(virtual_rig.Rig().drawn(4711), encoder=True, **SHAKEN, **hidden)
    plans = [
        virtual_rig.standard_plans(seed=seed, free=1, forced=2, rest=1, sample_time=0.002, duration=3.0)
        for seed in (4712, 4713)
    ]
    train, held_out = virtual_rig.record_many([(rig, plans[0], 4714), (rig, plans[1], 4715)])
    return train, held_out


@pytest.fixture(scope="module")
def by_model() -> dict[str, OneStepAhead]:
    """Of a rig whose encoder shows too much: by the base model, the right one, and one with an effect that is not there."""
    train, held_out = recorded(encoder_gain=GAIN)
    base = rtac.RTAC.from_rig(train)
    models = {
        "base": base,
        "right": holding(base + EncoderGain(error=GAIN - 1.0), ["encoder_gain"]),
        "wrong": base + CubicSpring(stiffness=1e3),
    }
    fits = {name: est.output_error(model, train, progress=False) for name, model in models.items()}
    first = one_step_ahead(fits["base"], train, held_out, {})
    return {name: one_step_ahead(fit, train, held_out, {}, like=first) for name, fit in fits.items()} | {"first": first}


@pytest.mark.slow
def test_the_right_effect_is_predicted_better(by_model: dict[str, OneStepAhead]) -> None:
    base, right = by_model["base"], by_model["right"]
    assert right.surpasses(base)
    assert not base.surpasses(right)
    assert right.log_likelihood > base.log_likelihood + 100.0
    # An encoder that shows too much contradicts the tachometer.
    assert right.errors["arm_velocity"] < 0.9 * base.errors["arm_velocity"]


@pytest.mark.slow
def test_an_effect_that_is_not_there_is_not(by_model: dict[str, OneStepAhead]) -> None:
    assert not by_model["wrong"].surpasses(by_model["base"])


@pytest.mark.slow
def test_errors_are_those_of_the_predictions(by_model: dict[str, OneStepAhead]) -> None:
    # Little more than its noise can be predicted wrongly of a sensor where the state is known.
    right = by_model["right"]
    assert set(right.errors) == {"cart_position", "arm_velocity", "arm_angle"}
    assert all(0.9 < error < 1.5 for error in right.errors.values()), right.errors


@pytest.mark.parametrize("seconds", [6, pytest.param(60, marks=pytest.mark.slow)])
def test_surpassing_takes_more_than_chance(seconds: int) -> None:
    of_sample = np.repeat(np.arange(seconds), 100)[:, None]

    def ahead(by_sample: np.ndarray, of_sample: np.ndarray = of_sample) -> OneStepAhead:
        return OneStepAhead(by_sample, of_sample, {}, (by_sample, by_sample))

    def share(gain: float, several: int) -> float:
        """In which the likeliest of several models surpasses one that is as likely as each but for the gain."""
        random, found = np.random.default_rng(1), 0
        for _ in range(1000):
            models = [ahead(gain + random.normal(size=of_sample.shape)) for _ in range(several)]
            best = max(models, key=lambda one: one.log_likelihood)
            found += best.surpasses(ahead(np.zeros(of_sample.shape)), of=several)
        return found / 1000

    assert 0.03 < share(0.0, 1) < 0.07
    assert share(0.0, 3) < 0.07
    assert share(1.0, 1) > 0.99
    few = of_sample[:400]
    assert not ahead(np.ones(few.shape), few).surpasses(ahead(np.zeros(few.shape), few))  # four stretches tell nothing


@pytest.mark.parametrize(
    ("seconds", "every", "length"), [((1.0, 1.5), 1, 0.3125), ((0.5,), 1, 0.25), ((12.0, 3.0), 8, 1.0)]
)
def test_short_data_are_cut_into_shorter_stretches(seconds: tuple[float, ...], every: int, length: float) -> None:
    """A sensor that is read every eighth sample does not make them shorter."""
    experiments = []
    for n, lasts in enumerate(seconds):
        values = np.sin(np.arange(round(lasts / 0.0025)))
        values[np.arange(len(values)) % every > 0] = np.nan
        experiments.append(rtac.Experiment.of(str(n), kind="free", sample_time=0.0025, cart_position=values))
    data = Data.of(experiments)
    assert predictive_likelihood._length(data) == pytest.approx(length, rel=0.02)
    assert len(np.unique(stretches(data, length)[: data.samples])) == round(sum(seconds) / length)


@pytest.mark.parametrize("seed", [11, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (12, 13))])
@pytest.mark.parametrize("correlated", [0.05, 0.3])
def test_short_stretches_do_not_reject_by_chance_although_they_are_correlated(correlated: float, seed: int) -> None:
    """Of two seconds; over as many seconds as differences are correlated. What is better by four deviations surpasses."""
    random, kept, found = np.random.default_rng(seed), np.exp(-0.002 / correlated), np.zeros(2)
    cut = np.repeat(np.arange(8), 125)[:, None]
    for _ in range(1000):
        white = random.normal(size=(1, 1000))
        gain = scipy.signal.lfilter([np.sqrt(1 - kept**2)], [1.0, -kept], white, zi=kept * random.normal(size=(1, 1)))[
            0
        ].T
        for place, more in enumerate((0.0, 4.0)):
            better, zero = (
                OneStepAhead(part, cut, {}, (part, part), short=True) for part in (gain + more, np.zeros_like(gain))
            )
            found[place] += better.surpasses(zero)
    by_chance, rightly = found / 1000
    assert by_chance < 0.06
    assert rightly > 0.99


@pytest.mark.slow
def test_what_one_model_finds_shaken_counts_for_none(by_model: dict[str, OneStepAhead]) -> None:
    first = by_model["first"]
    shaken = first.shaken[1] > 0
    assert shaken.any()
    assert np.all(first.by_sample != 0)
    for name in ("base", "right", "wrong"):
        assert np.all((by_model[name].by_sample == 0) == shaken)
