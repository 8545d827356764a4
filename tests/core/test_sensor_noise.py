"""The noise of a sensor: at rest, as stated, or read off a spectrum, also where samples are missing."""

import numpy as np
import pytest

import rtac_jax as rtac
from estimators.core.sensor_noise import noise_levels, only_rounding, quantisation_step, rounded, spectral_floor
from estimators.inference.simulation_residual import known_noise

MISSING = {
    "none": lambda index, random: index < 0,
    "three tenths at random": lambda index, random: random.random(len(index)) < 0.3,
    "six tenths at random": lambda index, random: random.random(len(index)) < 0.6,
    "one stretch": lambda index, random: (index > 700) & (index < 1000),
    "every third": lambda index, random: index % 3 == 1,
    "all but every fourth": lambda index, random: index % 4 != 0,
}


def decay(count, step, random, size=30):
    """A decaying oscillation, so many times the noise at its start, sampled at every `step`th place."""
    place = step * np.arange(count)
    return size * np.sin(0.05 * place + random.uniform(0, 6)) * np.exp(-place / 1500)


@pytest.mark.parametrize("size", [30, 3000])
@pytest.mark.parametrize(
    "which", [pytest.param(name, marks=[pytest.mark.slow] * name.endswith("at random")) for name in MISSING]
)
def test_missing_samples_take_no_noise_away(which, size) -> None:
    """The lowest of several bands lies below the noise, in a short record farther: as far as in a complete one of that length."""
    random = np.random.default_rng(3)
    index = np.arange(1500)
    step = 4 if which == "all but every fourth" else 1
    found, complete = [], []
    for _ in range(60):
        values = decay(1500, 1, random, size) + random.standard_normal(1500)
        values[MISSING[which](index, random)] = np.nan
        found.append(spectral_floor(values))
        complete.append(spectral_floor(decay(1500 // step, step, random, size) + random.standard_normal(1500 // step)))
    assert np.mean(found) / np.mean(complete) == pytest.approx(1.0, abs=0.05)
    assert np.std(found) / np.mean(found) < 0.16


@pytest.mark.parametrize("count", [400, 600, 3000])
def test_the_quietest_band_is_not_taken_for_quieter_than_it_is(count: int) -> None:
    """The least of several bands is below the noise by chance, and what that takes is known."""
    random = np.random.default_rng(4)
    found = [spectral_floor(decay(count, 1, random, 1000) + random.standard_normal(count)) for _ in range(100)]
    assert np.median(found) == pytest.approx(1.0, abs=0.04)


def test_few_samples_far_apart_have_a_level_too() -> None:
    values = np.full(100, np.nan)
    values[::20] = [0.0, 1.0, 0.5, 1.5, 0.2]
    assert np.isfinite(spectral_floor(values))


def test_noise_levels_from_rest_statement_and_spectrum() -> None:
    random = np.random.default_rng(0)
    time = 0.005 * np.arange(4000)
    motion = 0.01 * np.sin(10 * time) * np.exp(-0.2 * time)
    moving = rtac.Experiment.of(
        "a", kind="free", sample_time=0.005, cart_position=motion + 2e-5 * random.normal(size=4000)
    )
    rest = rtac.Experiment.of("r", kind="rest", sample_time=0.005, cart_position=3e-5 * random.normal(size=2000) + 1e-3)
    assert spectral_floor(moving.outputs["cart_position"].values) == pytest.approx(2e-5, rel=0.15)
    assert noise_levels([moving])["cart_position"] == pytest.approx(2e-5, rel=0.15)
    assert noise_levels([moving, rest])["cart_position"] == pytest.approx(3e-5, rel=0.1)
    stated = rtac.Experiment.of(
        "b", kind="free", sample_time=0.005, cart_position=motion, noise_std={"cart_position": 7e-5}
    )
    assert noise_levels([stated])["cart_position"] == pytest.approx(7e-5)
    coarse = np.round(motion / 1e-3) * 1e-3
    assert quantisation_step(coarse) == pytest.approx(1e-3, rel=1e-6)
    assert quantisation_step(motion) == 0.0


@pytest.mark.parametrize("reading", [0.0, 3.33])
def test_a_rest_record_that_reads_one_value_tells_no_noise(reading) -> None:
    """As that of an encoder, or of a coarse converter: its steps show where the arm moves."""
    time = 0.005 * np.arange(4000)
    angle = 0.5 * np.sin(10 * time) * np.exp(-0.2 * time)
    resting = rtac.Experiment.of("r", kind="rest", sample_time=0.005, arm_angle=np.full(400, reading))

    def levels(values):
        moving = rtac.Experiment.of("a", kind="free", sample_time=0.005, arm_angle=values)
        return noise_levels([moving])["arm_angle"], noise_levels([moving, resting])["arm_angle"]

    alone, beside = levels(np.round(angle / 1e-3) * 1e-3)
    assert beside == pytest.approx(alone) == pytest.approx(1e-3 / np.sqrt(12), rel=0.3)
    alone, beside = levels(angle + 2e-5 * np.random.default_rng(0).normal(size=4000))
    assert beside == pytest.approx(alone) == pytest.approx(2e-5, rel=0.2)
    recording = rtac.Recording([resting, rtac.Experiment.of("a", kind="free", sample_time=0.005, arm_angle=angle)])
    assert known_noise(recording) == frozenset()


def test_a_channel_that_reads_one_value_wherever_it_was_recorded_has_no_noise() -> None:
    rest = rtac.Experiment.of("r", kind="rest", sample_time=0.005, arm_angle=np.zeros(400))
    assert noise_levels([rest])["arm_angle"] == 1e-300


def test_a_rest_record_that_flickers_by_a_step_shows_the_step() -> None:
    """Where the arm moves fast, most of its readings differ."""
    resting = np.where(np.arange(400) % 90 == 0, 1e-3, 0.0)
    rest = rtac.Experiment.of("r", kind="rest", sample_time=0.005, arm_angle=resting)
    angle = np.round(2.0 * np.sin(3.0 * 0.005 * np.arange(400) + 0.3) / 1e-3) * 1e-3
    moving = rtac.Experiment.of("a", kind="free", sample_time=0.005, arm_angle=angle)
    assert noise_levels([rest, moving])["arm_angle"] == pytest.approx(1e-3 / np.sqrt(12))


def test_counts_that_a_file_rounds_are_steps_all_the_same() -> None:
    """Of an encoder of 4,096 lines in degrees with four digits, which rounds hundreds of counts apart."""
    count, time = 360 / 4096, 0.005 * np.arange(800)
    angle = np.radians(np.round(np.round(114.6 * np.sin(5 * time) / count) * count, 4))
    resting = np.radians(np.round(np.where(np.arange(400) % 90 == 0, count, 0.0), 4))
    rest = rtac.Experiment.of("r", kind="rest", sample_time=0.005, arm_angle=resting)
    moving = rtac.Experiment.of("a", kind="free", sample_time=0.005, arm_angle=angle)
    assert noise_levels([rest, moving])["arm_angle"] == pytest.approx(np.radians(count) / np.sqrt(12), rel=0.02)


def test_rounding_that_is_no_random_noise_is_told() -> None:
    """Of a coarse sensor that passes a fraction of a step in a sample, of one that passes many, and of one with noise beside it."""
    random, time = np.random.default_rng(3), 0.005 * np.arange(2000)
    motion, noise = 0.01 * np.sin(2 * time), 2e-5 * random.normal(size=2000)
    seen = {
        "slow": (1e-3, motion),
        "fast": (1e-5, motion),
        "noisy": (1e-5, motion + noise),
        "smooth": (0.0, motion + noise),
    }
    for name, (step, values) in seen.items():
        recorded = values if step == 0.0 else step * np.round(values / step)
        one = [rtac.Experiment.of("a", kind="free", sample_time=0.005, cart_position=recorded)]
        found = rounded(one, noise_levels(one))
        assert found == ({"cart_position": pytest.approx(1e-3)} if name == "slow" else {}), name
        alone = only_rounding(one, noise_levels(one))
        assert name == "fast" or alone == found, name
    time = 0.001 * np.arange(4000)
    quick = 1e-3 * np.round(0.05 * np.sin(80 * time) / 1e-3)
    one = [rtac.Experiment.of("a", kind="free", sample_time=0.001, cart_position=quick)]
    assert (rounded(one, noise_levels(one)), only_rounding(one, noise_levels(one))) == (
        {},
        {"cart_position": pytest.approx(1e-3)},
    )


def test_a_moving_record_that_reads_one_value_tells_no_noise() -> None:
    """As the cart's sensor while the cart is clamped."""
    random, time = np.random.default_rng(2), 0.005 * np.arange(2000)
    clamped = [
        rtac.Experiment.of(
            name, kind="forced", sample_time=0.005, cart="clamped", current=np.sin(time), cart_position=0 * time
        )
        for name in ("b", "c")
    ]
    free = rtac.Experiment.of(
        "a", kind="free", sample_time=0.005, cart_position=0.01 * np.sin(10 * time) + 2e-5 * random.normal(size=2000)
    )
    assert noise_levels([*clamped, free])["cart_position"] == pytest.approx(2e-5, rel=0.2)
