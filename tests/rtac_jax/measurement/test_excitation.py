"""Filters, differences and excitations, and what `describe` says of a recording."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal
from small_experiments import DECAY, DT, T, forced, free, noise, rest, spoilt

from rtac_jax.measurement import (
    Recording,
    Signal,
    central_difference,
    chirp,
    concerns,
    describe,
    multisine,
    prbs,
    square_wave,
    zero_phase_lowpass,
)


def test_lowpass_keeps_the_pass_band_in_phase_and_stops_the_rest():
    time = np.arange(4000) * 1e-3
    middle = slice(1000, 3000)
    low, high = np.sin(2 * np.pi * 5 * time + 0.3), np.sin(2 * np.pi * 60 * time)
    result = zero_phase_lowpass(low + high, sample_time=1e-3, cutoff=20.0)
    # Twice the ripple of 0.05 dB is 1.2 %; a delay of one sample alone would leave 3 %.
    assert np.abs(result - low)[middle].max() < 0.012
    assert np.abs(zero_phase_lowpass(high, sample_time=1e-3, cutoff=20.0))[middle].max() < 1e-4
    quadrature = np.cos(2 * np.pi * 5 * time + 0.3)
    assert abs(np.mean(result[middle] * quadrature[middle])) < 1e-6


def test_lowpass_is_symmetric_in_time_and_exact_on_constants():
    values = DECAY + noise(1)
    forward = zero_phase_lowpass(values, sample_time=DT, cutoff=20.0)
    backward = zero_phase_lowpass(values[::-1], sample_time=DT, cutoff=20.0)[::-1]
    inside = slice(300, -300)
    np.testing.assert_allclose(forward[inside], backward[inside], atol=2e-6)
    np.testing.assert_allclose(zero_phase_lowpass(0 * T + 3, sample_time=DT, cutoff=20.0), 3.0, rtol=1e-9)


@pytest.mark.parametrize(
    ("values", "cutoff", "message"),
    [
        (T, 250.0, "cutoff: is 250 Hz, .*half the sampling rate, 250 Hz"),
        (T, -1.0, "cutoff: is -1 Hz"),
        (T[:30], 20.0, "values: has 30 samples, but this filter needs more than 30"),
        (spoilt(T, 4, np.nan), 20.0, "values, sample 4: is nan"),
        (T[:, None], 20.0, r"values: the shape is \(2000, 1\)"),
    ],
)
def test_lowpass_refuses(values, cutoff, message):
    with pytest.raises(ValueError, match=message):
        zero_phase_lowpass(values, sample_time=DT, cutoff=cutoff)


def test_central_difference_is_exact_on_parabolas():
    result = central_difference(3 * T**2 - 2 * T + 1, sample_time=DT)
    assert result.shape == (len(T) - 2,)
    np.testing.assert_allclose(result, (6 * T - 2)[1:-1], atol=1e-9)
    with pytest.raises(ValueError, match="values: has 2 samples"):
        central_difference(T[:2], sample_time=DT)


@pytest.mark.parametrize("seed", [None, 3])
def test_multisine_has_the_asked_spectrum(seed):
    wave = multisine(samples=1500, sample_time=DT, rms=0.3, band=(2.0, 10.0), period=500, seed=seed)
    assert wave.shape == (1500,)
    np.testing.assert_allclose(wave[:500], wave[1000:])
    size = np.abs(np.fft.rfft(wave[:500]))
    assert np.flatnonzero(size > 1e-9 * size.max()).tolist() == list(range(2, 11))
    np.testing.assert_allclose(size[2:11], size[2])
    assert np.sqrt(np.mean(wave**2)) == pytest.approx(0.3)
    again = multisine(samples=1500, sample_time=DT, rms=0.3, band=(2.0, 10.0), period=500, seed=seed)
    np.testing.assert_array_equal(wave, again)


def test_other_currents():
    square = square_wave(samples=1000, sample_time=DT, amplitude=0.5, frequency=5.0)
    np.testing.assert_array_equal(square, np.tile(np.repeat([0.5, -0.5], 50), 10))
    sweep = chirp(samples=1000, sample_time=DT, amplitude=0.5, band=(1.0, 10.0))
    assert np.abs(sweep).max() <= 0.5
    assert abs(sweep[0]) < 1e-12
    binary = prbs(samples=1000, hold=8, amplitude=0.5, seed=1)
    assert binary.shape == (1000,)
    assert set(binary) == {-0.5, 0.5}
    assert set(np.flatnonzero(np.diff(binary)) % 8) == {7}
    assert abs(binary.mean()) < 0.1


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: multisine(samples=100, sample_time=DT, rms=1.0), "harmonics, band: give one"),
        (
            lambda: multisine(samples=100, sample_time=DT, rms=1.0, harmonics=[50]),
            r"harmonics: \[50\] .*1 to 49",
        ),
        (lambda: multisine(samples=100, sample_time=DT, rms=0.0, harmonics=[1]), "rms: is 0"),
        (lambda: multisine(samples=100, sample_time=DT, rms=1.0, band=(1, 300)), "band: 300 Hz"),
        (
            lambda: square_wave(samples=100, sample_time=DT, amplitude=1.0, frequency=250.0),
            "frequency: 250 Hz",
        ),
        (lambda: chirp(samples=0, sample_time=DT, amplitude=1.0, band=(1, 2)), "samples: is 0"),
        (lambda: prbs(samples=10, hold=0, amplitude=1.0, seed=0), "hold: is 0"),
    ],
)
def test_excitation_refuses(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def good():
    position = DECAY + noise(2)
    turned = (np.cos(1) - np.cos(8 * T + 1)) / 8
    angle = forced(cart_position=position, arm_angle=turned + noise(3), arm_velocity=np.sin(8 * T + 1) + noise(4))
    return Recording((angle, rest("still")), {"total_mass": 1.2})


def test_describe():
    words = describe(replace(good(), rig_name="lab", comment="after oiling"))
    assert "rig: lab; known beforehand: total_mass = 1.2 kg" in words
    assert "comment: after oiling" in words
    assert "experiments: 2 (1 forced, 1 rest), 4000 samples, 8 s" in words
    assert "forced: forced; 2000 samples of 0.002 s, 4 s" in words
    assert any(line.split() == ["current", "A", "0.702", "0", "zoh"] for line in words.splitlines())


def test_a_good_recording_has_one_small_fault():
    assert concerns(good()) == [
        "still: arm_velocity is exactly constant, so it says nothing about the noise; check that the sensor "
        "was connected."
    ]


@pytest.mark.parametrize("counts", [True, False])
def test_a_sensor_that_moves_in_steps_is_constant_at_rest(counts: bool) -> None:
    """An encoder; one that moves smoothly and is constant at rest was not connected there."""
    step = 1.5e-3 if counts else 1e-12
    turning = replace(forced(arm_angle=np.round(0.3 * np.sin(3 * T) / step) * step), name="driven")
    angle = Signal(np.full(rest().samples, 0.7), "rad")
    still = replace(rest("still"), outputs={**rest().outputs, "arm_angle": angle})
    said = concerns(Recording((turning, still)))
    assert any("still: arm_angle is exactly constant" in one for one in said) != counts


@pytest.mark.parametrize(
    ("experiment", "message"),
    [
        (free(), "There is no experiment at rest"),
        (free(), "The scale is not fixed"),
        (rest(), "All experiments are at rest"),
        (free(), "free: arm_angle was not measured"),
        (free(), "free: initial_arm_angle is not given"),
        (free(current=np.sin(T)), "an experiment of kind free has an input"),
        (free(arm="locked", cart="clamped"), "arm and cart are both held"),
        (forced(arm="locked"), "the current cannot move a locked arm"),
        (forced(cart="clamped", arm_velocity=None), "only what is held was measured"),
        (free().cut(0, 50), "fewer than 100 samples"),
        (free().cut(0, 50), "cart_position covers fewer than 3 periods"),
        (
            free(cart_position=np.sin(300 * T)),
            "cart_position is sampled fewer than 20 times in a period of its",
        ),
        (free(cart_position=np.clip(DECAY, -0.01, 0.01)), "cart_position stays at exactly -0.01 and 0.01 m"),
        (
            free(cart_position=np.round(DECAY / 2e-4) * 2e-4),
            "cart_position is quantised in steps of 0.0002 m",
        ),
        (
            free(cart_position=spoilt(DECAY, slice(20), np.nan)),
            "cart_position has 1 % of its samples missing",
        ),
        (
            free(cart_position=spoilt(spoilt(DECAY + noise(5), 900, 5e-3), slice(20), np.nan)),
            "cart_position has 1 suspicious outlier, the first at sample 900",
        ),
        # Found by the fuzzing of files: the frequency of such samples overflows when it is squared.
        (replace(free(), sample_time=1e-300), "cart_position shows accelerations of more than 10 g"),
    ],
)
def test_concerns(experiment, message):
    assert any(message in sentence for sentence in concerns(Recording((experiment,))))


def test_stated_noise_that_differs_is_a_concern():
    """Ten times noisier in one experiment: fits take one level for all, and no rest record decides."""

    def stated(name, level, **more):
        return replace(free(noise_std={"cart_position": level}, **more), name=name)

    told = [c for c in concerns(Recording((stated("a", 2e-5), stated("b", 2e-4)))) if "stated noise" in c]
    assert len(told) == 1
    for part in ("cart_position", "2e-05 in a", "0.0002 in b", "Recording.select"):
        assert part in told[0]
    alike = Recording((stated("a", 2e-5), stated("b", 2.5e-5)))
    resting = Recording((stated("a", 2e-5), stated("b", 2e-4), rest()))
    assert not any("stated noise" in c for r in (alike, resting) for c in concerns(r))


def test_concerns_do_not_cry_wolf():
    stopped = np.where(T > 3, DECAY[1500], DECAY)
    kinked = np.cumsum(np.sign(np.sin(5 * T))) * DT + noise(6)
    for values in (DECAY, DECAY + noise(7), stopped, kinked):
        words = " ".join(concerns(Recording((free(cart_position=values),))))
        assert "clipped" not in words
        assert "outliers" not in words
        assert "quantised" not in words


@pytest.mark.parametrize("count", [2 * np.pi / 500, 2 * np.pi / 2000, 2 * np.pi / 65536])
@pytest.mark.parametrize("digits", [4, 12])
def test_counts_of_an_encoder_are_no_faults(count, digits):
    """A swing that dies away, a start from rest, and turns, read by an encoder and written with few digits or with many."""
    quiet = np.where(T < 0.5, 0.0, 1.0)
    for angle in (0.5 * np.cos(6 * T) * np.exp(-T), quiet * 0.2 * (1 - np.cos(3 * (T - 0.5))), 8 * np.sin(1.5 * T)):
        read = np.round(np.degrees(np.floor(angle / count) * count), digits)
        words = " ".join(concerns(Recording((free(arm_angle=np.radians(read)),))))
        assert "outlier" not in words, (count, words)
        assert "drops out" not in words
        assert "spikes" not in words


def test_faults_among_counts_are_still_seen():
    count = 2 * np.pi / 2000
    angle = np.floor(0.5 * np.cos(6 * T) / count) * count
    lone, held = angle.copy(), angle.copy()
    lone[700] += 40 * count
    held[600:650] = held[599]
    assert any(
        "1 suspicious outlier, the first at sample 700" in c for c in concerns(Recording((free(arm_angle=lone),)))
    )
    assert any("one and the same value for 5" in c for c in concerns(Recording((free(arm_angle=held),))))


@pytest.mark.parametrize(("size", "still"), [(1.0, True), (10.0, False)])
def test_a_cart_that_no_experiment_moves_is_a_concern(size: float, still: bool) -> None:
    driven = forced(cart_position=size * noise(3))
    said = concerns(Recording((driven, rest())))
    assert any("dry friction holds the cart" in one for one in said) is still
    assert not any("dry friction holds" in one for one in concerns(Recording((driven,)))), "nothing tells the noise"


@pytest.mark.parametrize(
    ("begins", "said"),
    [
        (0.4, ""),
        (-0.4, "arm_angle begins at minus initial_arm_angle"),
        (np.rad2deg(0.4), "arm_angle begins at initial_arm_angle only if it is in degrees"),
        (1.3, "correct one of the two"),
    ],
)
def test_what_is_wrong_with_the_angle_at_the_start_is_said_once_for_all_experiments(begins: float, said: str) -> None:
    several = [replace(free(name, arm_angle=begins + 0.01 * T), initial_arm_angle=0.4) for name in ("a", "b")]
    told = [one for one in concerns(Recording(several)) if "initial_arm_angle" in one]
    assert len(told) == bool(said)
    assert all(one.startswith("a, b: ") and said in one for one in told)


@pytest.mark.parametrize(("memory", "told"), [(0.0, 0.99), (0.3, 0.99), (0.7, 0.0), (0.95, 0.0)])
def test_how_often_a_current_is_taken_for_noise(memory: float, told: float) -> None:
    """Of 400 draws each, autoregressive of the first order: nearly all of what forgets at once, none of what lasts."""
    random, count = np.random.default_rng(11), 0
    for _ in range(400):
        samples = int(random.integers(400, 2000))
        values = scipy.signal.lfilter([1.0], [1.0, -memory], random.standard_normal(samples))
        decay = free(cart_position=np.cos(np.arange(samples)))
        current = replace(forced().inputs["current"], values=5e-3 * values / np.std(values))
        still = replace(decay, inputs={"current": current})
        count += Recording((replace(forced(), name="driven"), still)).current_noise() > 0.0
    assert count >= 400 * told if told else count == 0


def test_an_encoder_that_is_zeroed_at_every_start_is_a_concern():
    def turned(name, by):
        angle = np.floor((0.3 * np.sin(3 * T) + by) / 1e-3) * 1e-3
        return replace(free(arm_angle=angle), name=name)

    for offsets, said in (((0.0, 0.0), True), ((0.0, 0.2), False), ((0.0,), False)):
        recording = Recording(tuple(turned(f"free_{n}", by) for n, by in enumerate(offsets)))
        assert any("zeroed at every start" in c for c in concerns(recording)) == said


WHITE = np.random.default_rng(3).standard_normal(len(T))


@pytest.mark.parametrize(
    ("values", "noise"),
    [
        (5e-3 * WHITE, True),
        (0.3 * WHITE, False),
        (5e-3 * np.sin(0.02 * np.arange(len(T))), False),
        (0.03 + 5e-3 * WHITE, False),
        (2e-3 + 5e-3 * WHITE, False),
        (5e-3 * np.sign(WHITE), False),
    ],
    ids=["noise", "a drive", "a sine", "noise about what drives", "noise about an offset", "a random binary drive"],
)
def test_the_noise_of_a_measured_current_is_told_for_what_it_is(values: np.ndarray, noise: bool) -> None:
    decay = free()
    measured = replace(decay, inputs={"current": replace(forced().inputs["current"], values=values)})
    said = concerns(Recording((replace(forced(), name="driven"), measured)))
    assert any("the current looks like noise of 0.005 A rms" in one for one in said) == noise
    assert any("has an input that is not zero; set its kind to forced" in one for one in said) == (not noise)
    alone = concerns(Recording((measured,)))
    assert any("set its kind to forced" in one for one in alone), "nothing tells how large a current drives this rig"
