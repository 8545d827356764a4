"""A robust fit finds the rig although samples are faulty, lists them, and states honest standard deviations."""

import numpy as np
import pytest
from scipy.stats import chi2
from spoilt_recordings import FORCED, FREE, POSITION, VELOCITY, channel, dropout, in_one, spikes

import estimators as est
from rtac_jax import RTAC, virtual_rig

RIG = virtual_rig.Rig(encoder=True)
PLANS = virtual_rig.standard_plans(seed=5, duration=3.0, free=1, forced=2)
TRUTH = {
    "spring_stiffness": RIG.spring_stiffness,
    "torque_constant": RIG.torque_constant,
    "eccentric_moment": RIG.eccentric_moment,
}


def spoilt(recording):
    """Spikes of two samples and a dropout in the position of a decay, and a dropout in the velocity of a forced run."""
    recording = in_one(recording, FREE, channel(POSITION, spikes(5e-3)))
    recording = in_one(recording, FREE, channel(POSITION, dropout(False)))
    return in_one(recording, FORCED, channel(VELOCITY, dropout(False)))


def fitted(recording, *, robust):
    return est.output_error(RTAC.from_rig(recording), recording, from_model=True, robust=robust, progress=False)


def sigmas(fit, parameter):
    found = fit.parameters[parameter]
    return abs(found.value - TRUTH[parameter]) / found.std


@pytest.fixture(scope="module")
def clean():
    return virtual_rig.record(RIG, PLANS, seed=6, step=5e-4)


@pytest.fixture(scope="module")
def fits(clean):
    """Least squares and robust, of the clean recording and of the spoilt one."""
    return {
        (bad, robust): fitted(spoilt(clean) if bad else clean, robust=robust)
        for bad in (False, True)
        for robust in (False, True)
    }


def test_faults_move_least_squares_and_not_a_robust_fit(fits):
    least = [fits[bad, False].parameters for bad in (False, True)]
    assert max(abs(least[0][name].value - least[1][name].value) / least[0][name].std for name in TRUTH) > 5, least
    assert max(least[1][name].std / least[0][name].std for name in TRUTH) > 3, least
    for bad in (False, True):
        assert max(sigmas(fits[bad, True], name) for name in TRUTH) < 4
    for name in TRUTH:
        before, after = (fits[bad, True].parameters[name] for bad in (False, True))
        assert abs(before.value - after.value) < 2 * before.std
        assert after.std < 1.2 * before.std


def test_what_is_discounted_is_listed(fits, clean):
    bad = spoilt(clean)
    found = {(one.experiment, one.channel): one for one in fits[True, True].discounted}
    assert set(found) == {(FREE, POSITION), (FORCED, VELOCITY)}
    for (name, which), one in found.items():
        moved = np.flatnonzero(bad[name].outputs[which].values != clean[name].outputs[which].values)
        assert set(one.samples) <= set(moved)
        # A dropout to zero shows nothing where the arm stands still for a moment.
        assert len(one.samples) > 0.8 * len(moved)
    first = found[FORCED, VELOCITY]
    said = f"{FORCED}, {VELOCITY}: {len(first.samples)} samples discounted, at {first.instants[0]:.4g}, "
    assert said in str(fits[True, True])


def test_of_clean_data_nothing_is_discounted_and_little_is_lost(fits):
    plain, robust = fits[False, False], fits[False, True]
    assert robust.discounted == ()
    assert "no sample is discounted" in str(robust)
    assert "discounted" not in str(plain)
    for name in TRUTH:
        # Of Gaussian data Student's score with four degrees of freedom, at the scale of Gauss, keeps some nine tenths.
        assert 1.0 < robust.parameters[name].std / plain.parameters[name].std < 1.15
        assert robust.residual_std.keys() == plain.residual_std.keys()


def test_covariances_of_a_robust_fit_keep_its_weights(fits, clean):
    spread = est.covariances(fits[True, True], spoilt(clean))
    for name in TRUTH:
        assert spread.std("sandwich")[name] == pytest.approx(fits[True, True].parameters[name].std, rel=0.4)


@pytest.mark.slow
def test_the_stated_deviations_are_those_over_many_recordings(clean):
    """Spikes and a dropout in each of them, at the same places, and fresh noise."""
    draws = 24
    estimates, stated = [], []
    for draw in range(draws):
        fit = fitted(spoilt(virtual_rig.record(RIG, PLANS, seed=100 + draw, step=5e-4)), robust=True)
        estimates.append([fit.parameters[name].value for name in TRUTH])
        stated.append([fit.parameters[name].std for name in TRUTH])
    # With so many draws the ratio of variances lies in this interval with a probability of 99.9 %.
    low, high = chi2.ppf([0.0005, 0.9995], draws - 1) / (draws - 1)
    ratio = np.var(estimates, axis=0, ddof=1) / np.mean(np.square(stated), axis=0)
    assert np.all((low < ratio) & (ratio < high)), ratio


PLACES = (100, 101, 350, 351, 600, 601)


@pytest.mark.slow
@pytest.mark.parametrize("spiked", [("forced_2",), ("free_1", "free_2", "forced_1", "forced_2", "forced_3")])
def test_spikes_far_beyond_the_motion_do_not_lead_the_starts_astray(spiked):
    plans = virtual_rig.standard_plans(seed=1, duration=4.0, free=2, forced=3)
    recording = virtual_rig.record(virtual_rig.Rig(), plans, seed=1)
    for name in spiked:
        recording = in_one(recording, name, channel(POSITION, far_spikes))
    start = RTAC.from_rig(recording)
    found = est.output_error(start, recording, robust=True, progress=False)
    assert found.result == est.RESULTS.successful
    assert max(sigmas(found, name) for name in TRUTH) < 4
    listed = {one.experiment: one.samples for one in found.discounted if one.channel == POSITION}
    assert listed == dict.fromkeys(spiked, PLACES)


def far_spikes(values):
    values = values.copy()
    for place, sign in zip(PLACES[::2], (1, -1, 1), strict=True):
        values[place : place + 2] += sign * 0.02
    return values
