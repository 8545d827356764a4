"""Frequency responses against linear systems whose response is known, and static nonlinearities whose distortion is."""

import re

import control as ct
import numpy as np
import pytest
import scipy.signal

import estimators as est
import rtac_jax as rtac
from estimators.frequency_response.local_polynomial import local_response
from rtac_jax.measurement import Experiment, Recording, harmonic_grid, multisine
from rtac_jax.virtual_rig import Plan, Rig, record

DT = 0.02
NUMERATOR, DENOMINATOR = [2.0, 30.0], [1.0, 1.6, 110.0]
A, B, C, D, _ = scipy.signal.cont2discrete(scipy.signal.tf2ss(NUMERATOR, DENOMINATOR), DT)


def truth(omega):
    return np.polyval(NUMERATOR, 1j * omega) / np.polyval(DENOMINATOR, 1j * omega)


def held_truth(omega):
    """Response of the sampled system, the factor of the hold taken out: what a record with held inputs can show."""
    z = np.exp(1j * omega * DT)
    sampled = np.array([(C @ np.linalg.solve(each * np.eye(2) - A, B) + D)[0, 0] for each in z])
    return sampled / (np.sinc(omega * DT / (2 * np.pi)) * np.exp(-0.5j * omega * DT))


def respond(current, start=(0.0, 0.0)):
    """Outputs of the held system for inputs [run, sample], all runs at once."""
    state = np.broadcast_to(np.asarray(start), (len(current), 2)).copy()
    out = np.empty_like(current)
    for n in range(current.shape[1]):
        out[:, n] = state @ C[0] + D[0, 0] * current[:, n]
        state = state @ A.T + current[:, n : n + 1] * B[:, 0]
    return out


def recording(current, out, **options):
    experiments = [
        Experiment.of(f"run_{i + 1}", kind="forced", sample_time=DT, current=u, cart_position=y, **options)
        for i, (u, y) in enumerate(zip(current, out, strict=True))
    ]
    return Recording(tuple(experiments))


def inside(responses, confidence=0.95):
    """Fraction of runs and lines whose disc holds the truth."""
    expected = held_truth(responses.frequency)
    return np.mean([np.abs(one.response - expected) <= one.radius(confidence) for one in responses])


RUNS, PERIOD, PERIODS, NOISE = 200, 500, 6, 0.3


@pytest.fixture(scope="module")
def periodic():
    """200 runs of one multisine from different starts with white noise, transients included."""
    random = np.random.default_rng(0)
    lines = harmonic_grid("random_odd", period=PERIOD, sample_time=DT, band=(0.3, 8.0), seed=1)
    wave = multisine(samples=PERIODS * PERIOD, period=PERIOD, sample_time=DT, rms=1.0, harmonics=lines, seed=2)
    current = np.tile(wave, (RUNS, 1))
    clean = respond(current, random.normal(0, 0.05, (RUNS, 2)))
    return recording(current, clean + NOISE * random.standard_normal(clean.shape)), lines


def test_periodic_discs_hold_the_truth_as_often_as_they_say(periodic):
    data, lines = periodic
    found = est.frequency_responses(data, compensate=False, period=PERIOD)
    np.testing.assert_allclose(found.frequency, 2 * np.pi * lines / (PERIOD * DT))
    assert 0.92 < inside_noise(found, 0.95) < 0.98
    assert 0.47 < inside_noise(found, 0.5) < 0.53


def inside_noise(responses, confidence):
    # The system is linear, so noise alone is at work, and the detected distortion is what noise leaves by chance.
    expected = held_truth(responses.frequency)
    factor = [one.radius(confidence) / one.std * one.noise_std for one in responses]
    return np.mean([np.abs(one.response - expected) <= r for one, r in zip(responses, factor, strict=True)])


def test_periodic_noise_level_is_right_and_no_distortion_is_seen(periodic):
    data, lines = periodic
    found = est.frequency_responses(data, compensate=False, period=PERIOD)
    size = np.abs(np.fft.rfft(data["run_1"].inputs["current"].values[:PERIOD]))[lines]
    hold = np.abs(np.sinc(found.frequency * DT / (2 * np.pi)))
    expected = NOISE * np.sqrt(PERIOD / PERIODS) / size / hold  # of a mean over the periods
    noise = np.sqrt(np.mean([one.noise_std**2 for one in found], axis=0))
    np.testing.assert_allclose(noise, expected, rtol=0.25)
    actual = np.sqrt(np.mean(np.abs(found.response - held_truth(found.frequency)) ** 2, axis=0))
    np.testing.assert_allclose(actual, noise, rtol=0.25)
    for level in ("odd_distortion", "even_distortion"):
        assert np.median([getattr(one, level) / one.noise_std for one in found]) < 0.6


@pytest.mark.parametrize(("poles", "half_width"), [(0, 6), pytest.param(2, 12, marks=pytest.mark.slow)])
def test_local_discs_hold_the_truth_as_often_as_they_say(poles, half_width):
    random = np.random.default_rng(1)
    current = random.standard_normal((RUNS, 3000))
    clean = respond(current, random.normal(0, 0.05, (RUNS, 2)))
    data = recording(current, clean + NOISE * random.standard_normal(clean.shape))
    found = est.frequency_responses(
        data, compensate=False, band=(0.3, 8.0), half_width=half_width, poles=poles, method="local"
    )
    assert 0.92 < inside(found, 0.95) < 0.98
    assert 0.45 < inside(found, 0.5) < 0.55


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.1, 1.0])
def test_coherence_is_the_share_of_power_that_a_known_noise_leaves(noise):
    random = np.random.default_rng(7)
    current = random.standard_normal((40, 3000))
    clean = respond(current)
    data = recording(current, clean + noise * random.standard_normal(clean.shape))
    found = est.frequency_responses(data, compensate=False, band=(0.5, 6.0), method="local")
    omega = found.frequency
    size = (
        np.abs(held_truth(omega) * np.sinc(omega * DT / (2 * np.pi))) ** 2
    )  # of the sampled system, by white input of 1
    expected = size / (size + noise**2)
    shown = np.mean([one.coherence for one in found], axis=0)
    assert np.ptp(expected) > 0.3, "from lines with much noise to lines with little"
    # Within the scatter of a power over 25 lines; the square root, another definition, would be off by up to 0.25.
    np.testing.assert_allclose(shown, expected, atol=0.1)


def test_local_fractions_follow_a_resonance_that_polynomials_miss():
    random = np.random.default_rng(2)
    current = random.standard_normal((1, 1200))
    data = recording(current, respond(current, (0.3, -0.2)))
    worst = {}
    for poles in (0, 2):
        found = est.frequency_responses(data, compensate=False, band=(0.3, 8.0), half_width=10, poles=poles)
        worst[poles] = np.max(np.abs(found.response[0] / held_truth(found.frequency) - 1))
    assert worst[2] < 1e-4
    assert worst[0] > 1e-2


@pytest.mark.parametrize("hold", ["zoh", "foh", "bl"])
def test_response_is_that_of_the_continuous_system_whatever_the_hold(hold):
    samples, step = 4000, 0.005
    wave = multisine(samples=samples, sample_time=step, rms=1.0, band=(0.3, 4.0), seed=3, period=1000)
    if hold == "bl":
        spectrum = np.fft.rfft(wave)
        omega = 2 * np.pi * np.fft.rfftfreq(samples, step)
        out = np.fft.irfft(spectrum * truth(omega), samples)
    else:
        a, b, c, d, _ = scipy.signal.cont2discrete(scipy.signal.tf2ss(NUMERATOR, DENOMINATOR), step, hold)
        # Long enough before the record for its steady state.
        out = scipy.signal.dlsim((a, b, c, d, step), np.tile(wave, 3))[1][-samples:, 0]
    experiment = Experiment.of(
        "run", kind="forced", sample_time=step, current=wave, cart_position=out, intersample=hold
    )
    found = est.frequency_responses(Recording((experiment,)), compensate=False, period=1000)[0]
    np.testing.assert_allclose(found.response, truth(found.frequency), rtol=2e-3)
    unheld = np.sinc(found.frequency * step / (2 * np.pi)) * np.exp(-0.5j * found.frequency * step)
    if hold == "zoh":
        assert np.max(np.abs(found.response * unheld / truth(found.frequency) - 1)) > 0.05, "the hold matters here"


# -- distortion -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("power", "size"), [(2, 0.2), (3, 0.1)])
def test_distortion_is_told_from_noise_and_even_from_odd(power, size):
    random = np.random.default_rng(4)
    lines = harmonic_grid("random_odd", period=PERIOD, sample_time=DT, band=(0.3, 8.0), seed=1)
    found, actual = [], []
    for seed in range(20):
        wave = multisine(samples=PERIODS * PERIOD, period=PERIOD, sample_time=DT, rms=1.0, harmonics=lines, seed=seed)
        clean = wave + size * wave**power
        data = recording(wave[None], clean[None] + 0.02 * random.standard_normal((1, len(wave))))
        found.append(est.frequency_responses(data, compensate=False, period=PERIOD)[0])
        actual.append(np.fft.rfft(clean[:PERIOD])[lines] / np.fft.rfft(wave[:PERIOD])[lines])
    odd = np.mean([np.median(one.odd_distortion) for one in found])
    even = np.mean([np.median(one.even_distortion) for one in found])
    noise = np.mean([np.median(one.noise_std) for one in found])
    if power == 2:
        assert even > 10 * noise
        assert odd < 0.5 * noise
        assert np.std(actual, axis=0).max() < 1e-12, "an even nonlinearity does not reach odd lines"
    else:
        assert even < 0.5 * noise
        # What the odd detection lines show is the scatter of the response from one realisation to the next.
        assert odd == pytest.approx(np.median(np.std(actual, axis=0)), rel=0.3)
        total = np.mean([np.median(one.std) for one in found])
        assert total == pytest.approx(np.hypot(odd, noise), rel=0.15)


def test_mean_over_realisations_is_the_best_linear_approximation():
    lines = harmonic_grid("odd", period=PERIOD, sample_time=DT, band=(0.3, 8.0))
    current = np.stack(
        [
            multisine(samples=2 * PERIOD, period=PERIOD, sample_time=DT, rms=1.0, harmonics=lines, seed=s)
            for s in range(40)
        ]
    )
    data = recording(current, current + 0.1 * current**3)
    flat = Experiment.of  # the static system needs no hold: its input is taken as band-limited
    experiments = tuple(
        flat(e.name, kind="forced", sample_time=DT, current=e.inputs["current"].values, intersample="bl",
             cart_position=e.outputs["cart_position"].values)
        for e in data
    )  # fmt: skip
    whole = est.frequency_responses(
        Recording(experiments), compensate=False, period=PERIOD, realisations={"all": [e.name for e in experiments]}
    )[0]
    # Of a Gaussian input with variance 1, the best linear approximation of u + 0.1 u^3 is 1.3; with F lines the cubic
    # terms at a line number 3 (2 F - 1) / (2 F) instead of 3 per unit of variance.
    count = len(lines)
    expected = 1 + 0.3 * (1 - 0.5 / count)
    assert np.mean(np.abs(whole.response - expected) <= whole.radius(0.95)) > 0.85
    assert abs(np.mean(whole.response) - expected) < 4 * np.mean(whole.std) / np.sqrt(count)
    assert whole.freedom == 39
    assert np.median(whole.std) > 100 * np.median(whole.noise_std), "all of the scatter is distortion"


# -- compensation ---------------------------------------------------------------------------------------------------------


def test_compensation_recovers_a_response_that_a_turning_arm_hides():
    random = np.random.default_rng(5)
    current = multisine(samples=4000, sample_time=DT, rms=1.0, band=(0.3, 8.0), seed=1)
    time = DT * np.arange(4000)
    responses = {}
    for compensate in (True, False):
        found = []
        for number, middle in enumerate((0.3, 2.5)):
            angle = middle + 0.5 * np.sin(0.9 * time + number)
            out = respond((current * np.cos(angle))[None])[0] + 1e-3 * random.standard_normal(4000)
            experiment = Experiment.of(
                "turning", kind="forced", sample_time=DT, current=current, cart_position=out, arm_angle=angle
            )
            found.append(est.frequency_responses(Recording((experiment,)), compensate=compensate, band=(0.5, 7.0))[0])
        responses[compensate] = found
    expected = held_truth(responses[True][0].frequency)
    for one, middle in zip(responses[True], (0.3, 2.5), strict=True):
        assert np.max(np.abs(one.response / expected - 1)) < 0.05
        assert one.arm_angle == pytest.approx(middle, abs=0.05)
        np.testing.assert_allclose(one.actual(1.0), one.response * np.cos(1.0))
    assert np.median(np.abs(responses[False][1].response / expected - 1)) > 1, "gain and sign are lost"
    assert not responses[False][0].compensated


def test_angle_is_measured_given_of_a_model_or_integrated_with_its_drift_taken_off():
    rig = Rig(encoder=True, tacho_bias=0.05, position_noise=1e-6, quantisation_bits=None)
    wave = multisine(samples=2000, sample_time=0.01, rms=0.1, band=(1.0, 6.0), seed=1)
    plans = [Plan("run", "forced", 20.0, 0.01, wave, initial_angle=0.4), Plan("rest", "rest", 20.0, 0.01)]
    full = record(rig, plans, seed=1)
    angle = full["run"].outputs["arm_angle"].values
    from estimators.frequency_response.angle_reconstruction import arm_angles

    def without(*names):
        kept = {k: s.values for k, s in full["run"].outputs.items() if k not in names}
        run = Experiment.of("run", kind="forced", sample_time=0.01, current=wave, initial_arm_angle=0.4, **kept)
        return Recording((run, full["rest"]))

    assert np.array_equal(arm_angles(full, ["run"])["run"], angle)
    assert np.array_equal(arm_angles(without("arm_angle"), ["run"], {"run": angle})["run"], angle)
    integrated = arm_angles(without("arm_angle"), ["run"])["run"]
    assert np.max(np.abs(integrated - angle)) < 0.1  # 20 s of white noise of 0.05 rad/s walk 0.02 rad
    alone = arm_angles(Recording((without("arm_angle")["run"],)), ["run"])["run"]
    assert np.max(np.abs(alone - angle)) > 0.5, "the bias of 0.05 rad/s over 20 s"
    simulated = arm_angles(without("arm_angle", "arm_velocity"), ["run"], model=rtac.RTAC.paper())["run"]
    assert np.max(np.abs(simulated - angle)[:500]) < 0.05
    with pytest.raises(ValueError, match="/experiments/run: nothing tells the arm's angle"):
        arm_angles(without("arm_angle", "arm_velocity"), ["run"])


# -- records and refusals ----------------------------------------------------------------------------------------------------


def test_conversion_to_python_control_and_a_common_grid(periodic):
    data, _ = periodic
    few = data.select(["run_1", "run_2"])
    found = est.frequency_responses(few, compensate=False, period=PERIOD)
    systems = found.frd()
    assert all(isinstance(one, ct.FrequencyResponseData) for one in systems)
    np.testing.assert_allclose(np.ravel(systems[1].frdata), found["run_2"].response)
    assert found.response.shape == found.std.shape == (2, len(found.frequency))
    assert "run_2" in str(found)
    figure = found.plot()
    assert re.fullmatch(r"2 conditions, each known to [\d.e+]+ % \(95 % radius, median\)", figure.get_suptitle())
    assert all(axes.lines and axes.get_ylabel() for axes in figure.axes)
    grid = np.linspace(3.0, 40.0, 50)
    shorter = Recording((few["run_1"], few["run_2"].cut(0, 2111, "short")))
    same = est.frequency_responses(shorter, compensate=False, frequency=grid, method="local", half_width=30)
    np.testing.assert_allclose(same.frequency, grid)
    assert np.median(np.abs(same.response / held_truth(grid) - 1)) < 0.3
    separate = est.frequency_responses(shorter, compensate=False, band=(1, 6), method="local", half_width=30)
    with pytest.raises(ValueError, match="short has other frequencies than run_1"):
        _ = separate.response


def _plain(**options):
    random = np.random.default_rng(6)
    current = options.pop("current", None)
    if current is None:
        current = random.standard_normal(400)
    out = options.pop("out", None)
    if out is None:
        out = respond(current[None])[0]
    run = Experiment.of("run", kind="forced", sample_time=DT, current=current, cart_position=out)
    return est.frequency_responses(Recording((run,)), compensate=False, **options)


def _gap():
    """A current with nothing between 2 and 4 Hz."""
    low = multisine(samples=2000, sample_time=DT, rms=1.0, band=(0.5, 2.0), seed=1)
    return low + multisine(samples=2000, sample_time=DT, rms=1.0, band=(4.0, 6.0), seed=2)


REPEATED = multisine(samples=1200, period=400, sample_time=DT, rms=1.0, band=(0.5, 4.0), seed=1)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: _plain(input="voltage"), "input: there is no channel 'voltage'"),
        (lambda: _plain(output="force"), "output: there is no channel 'force'"),
        (lambda: _plain(method="welch"), "method: is 'welch'"),
        (lambda: _plain(output="arm_angle"), "/experiments/run: has no arm_angle"),
        (lambda: _plain(method="periodic"), "needs a period with at least two"),
        (lambda: _plain(method="periodic", period=300), "at least two of them in 400"),
        (lambda: _plain(method="periodic", period=100), "does not repeat every 100 samples"),
        (lambda: _plain(current=_gap(), band=(1.0, 5.0)), r"the excitation vanishes at 1\d\.\d+ rad/s"),
        (lambda: _plain(current=REPEATED, period=400, band=(6.0, 8.0)), "vanishes on every harmonic"),
        (lambda: _plain(out=np.random.default_rng(1).normal(size=400)), "hardly moves cart_position"),
        (lambda: _plain(current=np.ones(400)), "current is constant at 1"),
        (lambda: _plain(out=np.where(np.arange(400) == 7, np.nan, np.arange(400.0))), "has missing samples"),
        (lambda: _plain(half_width=3), "half_width: 3 lines to each side give 7 equations for 8"),
        (lambda: _plain(half_width=300), "does not fit into a spectrum"),
        (lambda: _plain(discard=399), "discard: 399 of the 400 samples"),
        (lambda: _plain(frequency=np.array([1000.0])), "lines outside"),
        (lambda: _plain(realisations={"a": ["nobody"]}), "realisations: a names nobody"),
    ],
)
def test_refusals(call, message):
    with pytest.raises(ValueError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_a_current_that_is_silent_where_the_arm_has_no_grip_still_has_its_period():
    """As a design plays it: some samples of some periods are zero, and so little of the response is lost."""
    silent = REPEATED.copy()
    silent[[3, 407, 408, 411, 1190]] = 0.0
    out = respond(silent[None])[0]
    known = est.frequency_responses(
        Recording((_run(REPEATED, respond(REPEATED[None])[0]),)), compensate=False, period=400
    )
    found = est.frequency_responses(Recording((_run(silent, out),)), compensate=False, method="periodic", period=400)
    np.testing.assert_array_equal(found.frequency, known.frequency)
    np.testing.assert_allclose(found[0].response, truth(found.frequency), rtol=0.05)
    burst = np.where(np.arange(1200) < 100, REPEATED, 0.0)
    for wrong in (np.where(np.arange(1200) % 3, REPEATED, 0.0), np.append(REPEATED[:800], 2 * REPEATED[800:]), burst):
        with pytest.raises(ValueError, match="does not repeat every 400 samples"):
            _plain(current=wrong, out=out, method="periodic", period=400)


def _run(current, out):
    return Experiment.of("run", kind="forced", sample_time=DT, current=current, cart_position=out)


def test_what_only_compensation_puts_into_a_band_is_no_excitation():
    current = multisine(samples=2000, sample_time=DT, rms=1.0, band=(0.5, 2.0), seed=1)
    turning = {"run": 2.0 * np.sin(0.9 * DT * np.arange(2000))}  # spreads current * cos(theta) over all lines
    out = respond((current * np.cos(turning["run"]))[None])[0]
    run = Experiment.of("run", kind="forced", sample_time=DT, current=current, cart_position=out)
    with pytest.raises(ValueError, match="the excitation vanishes at"):
        est.frequency_responses(Recording((run,)), band=(3.0, 6.0), angles=turning)
    with pytest.raises(ValueError, match="the excitation vanishes at"):  # nor where the period is cut
        est.frequency_responses(Recording((run,)), band=(3.0, 6.0), angles=turning, discard=1)
    assert len(est.frequency_responses(Recording((run,)), band=(0.5, 2.0), angles=turning)) == 1


@pytest.mark.slow
def test_a_resonance_far_below_a_wide_band_is_shown():
    random = np.random.default_rng(8)
    current = random.standard_normal(4000)
    out = respond(current[None])[0]
    slow = scipy.signal.sosfilt(scipy.signal.butter(8, 0.15, output="sos"), out)  # nothing above 3.75 Hz of 25
    found = _plain(current=current, out=slow + 0.05 * np.std(out) * random.standard_normal(4000))
    assert np.mean(found[0].std > 0.5 * np.abs(found[0].response)) > 0.5  # most of the band drowns


def test_local_response_finds_an_exact_local_model():
    random = np.random.default_rng(7)
    into = random.standard_normal(101) + 1j * random.standard_normal(101)
    place = np.arange(101) - 50.0
    denominator = 1 + 0.02 * place - 0.0004 * place**2
    out = ((2 - 0.01 * place) * into + 0.3 + 0.001 * place) / denominator
    found = local_response(into, out, np.array([50.0]), half_width=10)
    assert found.response[0] == pytest.approx(2.0, abs=1e-10)
    assert found.std[0] < 1e-10
