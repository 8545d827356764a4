"""The colour of sensor noise, from rest records and, more exact, from motion beside them; what is missing is no colour."""

import dataclasses

import numpy as np
import pytest
from hidden_effects import recorded
from scipy.signal import lfilter

import estimators as est
import rtac_jax as rtac
from estimators.core.progress import Progress
from estimators.diagnosis.base_predictor import fit_base
from estimators.diagnosis.noise_colour import recoloured
from estimators.diagnosis.setting import setting_of
from estimators.prediction_error.coloured_noise import RestSpectrum, colours_at_rest, likeliest_colours, rest_spectra
from rtac_jax.measurement import Experiment

KEEP, INTERVAL = 0.9, 0.005
MEMORY = -INTERVAL / np.log(KEEP)


def resting(seed, *, samples=1000, share=1.0):
    """A rest record of first-order coloured noise, with a white share and quantised."""
    random = np.random.default_rng(seed)
    white = np.sqrt(1 - KEEP**2) * random.standard_normal(samples + 300)
    noise = np.sqrt(share) * lfilter([1.0], [1.0, -KEEP], white)[300:]
    noise += np.sqrt(1 - share) * random.standard_normal(samples)
    return Experiment.of("rest", kind="rest", sample_time=INTERVAL, cart_position=1e-5 * np.round(noise / 0.3) * 0.3)


@pytest.mark.parametrize(("share", "bound"), [(1.0, 0.2), (0.8, 0.27)])
def test_a_rest_record_tells_the_colour_about_as_well_as_it_can(share, bound):
    """Of 1,000 samples no estimate of the correlation time scatters by less than 15 % where all is coloured."""
    found = [colours_at_rest([resting(seed, share=share)])["cart_position"] for seed in range(60)]
    away = np.log([memory / MEMORY for _, memory in found])
    assert abs(np.mean(away)) < 0.1
    assert np.sqrt(np.mean(away**2)) < bound
    assert abs(np.mean([one for one, _ in found]) - share) < 0.05


def test_white_noise_has_no_colour():
    random = np.random.default_rng(0)
    white = [
        Experiment.of("rest", kind="rest", sample_time=INTERVAL, cart_position=1e-5 * random.standard_normal(1000))
        for _ in range(100)
    ]
    assert not any(colours_at_rest([one]) for one in white)
    assert colours_at_rest([resting(0, samples=100)]) == {}, "too short to tell"


def test_the_likelihood_is_largest_at_what_is_said():
    spectrum = RestSpectrum.of([resting(1, samples=4000, share=0.7)], "cart_position")
    assert spectrum is not None
    share, memory = spectrum.colour()
    there = spectrum.log_likelihood(share, memory)
    assert all(
        spectrum.log_likelihood(share + a, memory * b) < there
        for a in (-0.05, 0, 0.05)
        for b in (0.8, 1, 1.25)
        if a or b != 1
    )


def test_the_search_climbs_along_every_fraction_and_correlation_time():
    def likelihood(colours):
        (share, memory), (other, slow) = colours["cart_position"], colours["arm_velocity"]
        shares = (np.log(share / (1 - share)) - 1.0) ** 2 + (np.log(other / (1 - other)) - 2.0) ** 2
        return -10 * shares - 100 * np.log(memory / 0.02) ** 2 - 100 * np.log(slow / 0.01) ** 2

    found, gained = likeliest_colours({"cart_position": (0.5, 0.03), "arm_velocity": (0.9, 0.009)}, likelihood)
    assert found["cart_position"] == pytest.approx((1 / (1 + np.exp(-1)), 0.02), rel=1e-6)
    assert found["arm_velocity"] == pytest.approx((1 / (1 + np.exp(-2)), 0.01), rel=1e-6)
    assert gained == pytest.approx(10 + 10 * (np.log(9) - 2) ** 2 + 100 * np.log(1.5) ** 2 + 100 * np.log(0.9) ** 2)


@pytest.fixture(scope="module")
def recordings():
    coloured = {"noise_correlation": KEEP}
    return recorded(
        {"nothing": coloured, "cogging": coloured | {"cogging_torque": 4e-4, "cogging_order": 7.0}}, first=40
    )


@pytest.mark.slow
def test_motion_makes_the_colour_more_exact(recordings):
    recording = recordings["nothing"]
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    setting = setting_of(fit, recording, [rtac.effects.Cogging], Progress("diagnose", show=False))
    base = fit_base(setting)
    better, refit = recoloured(setting, base)
    assert refit.predictor.log_likelihood > base.predictor.log_likelihood
    assert better.colours.keys() == {"cart_position", "arm_velocity"}
    before, after = (np.log([memory / MEMORY for _, memory in one.colours.values()]) for one in (setting, better))
    assert np.linalg.norm(after) < np.linalg.norm(before)
    for share, memory in better.colours.values():
        assert memory == pytest.approx(MEMORY, rel=0.1)
        assert share > 0.9


@pytest.mark.slow
def test_the_colour_stays_where_the_rest_record_does_not_speak_against_it(recordings):
    """A rest record of noise as large as that of the motion, but with less memory."""
    keep, random = 0.5, np.random.default_rng(3)
    experiments = []
    for e in recordings["nothing"]:
        if e.kind == "rest":
            white = random.standard_normal((3, e.samples + 300))
            slow = np.sqrt(1 - keep**2) * lfilter([1.0], [1.0, -keep], white)[:, 300:]
            outputs = {
                channel: dataclasses.replace(signal, values=np.std(signal.values) * noise)
                for (channel, signal), noise in zip(e.outputs.items(), slow, strict=False)
            }
            experiments.append(dataclasses.replace(e, outputs=outputs))
        else:
            experiments.append(e)
    recording = rtac.Recording(tuple(experiments), rig=recordings["nothing"].rig)
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    setting = setting_of(fit, recording, [rtac.effects.Cogging], Progress("diagnose", show=False))
    better, _ = recoloured(setting, fit_base(setting))
    spectra = rest_spectra(recording.experiments)
    lost = {}
    for channel, (share, memory) in setting.colours.items():
        now_share, now = better.colours[channel]
        assert memory < now < MEMORY, "the motion asks for more memory, and the rest record allows a little"
        least = spectra[channel].log_likelihood(share, memory)
        lost[channel] = least - spectra[channel].log_likelihood(now_share, now)
        assert least - spectra[channel].log_likelihood(share, MEMORY) > 20, "all of it would be spoken against"
    assert all(0 < one <= 4.5 for one in lost.values())


@pytest.mark.slow
def test_an_effect_is_named_in_coloured_noise(recordings):
    for name, effects in (("nothing", []), ("cogging", ["cogging"])):
        recording = recordings[name]
        fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
        found = est.diagnose(fit, recording, thorough=False, progress=False)
        assert [c.id for c in found.effects] == effects, found
        assert found.verdict == ("missing" if effects else "adequate")
