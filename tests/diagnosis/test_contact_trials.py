"""A play, which the likelihood shows by steps only, is found by trial where a fit along derivatives ends beside it."""

import dataclasses
import inspect
from types import SimpleNamespace

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from estimators.core.deadline import Deadline, OutOfTimeError
from estimators.core.parameter_space import Space
from estimators.core.progress import Progress
from estimators.diagnosis import contact_trials
from estimators.diagnosis.base_predictor import fit_base
from estimators.diagnosis.contact_trials import acting_on_arm, begins_of, in_turn
from estimators.diagnosis.innovation_tests import screened_at_low_noise
from estimators.diagnosis.refit import Refit
from estimators.diagnosis.refitting import refit_thoroughly, refit_with
from estimators.diagnosis.setting import setting_of
from rtac_jax import virtual_rig
from rtac_jax.effects import Backlash, Cogging, CubicSpring, CurrentLag, TachoBias


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "rotor"),
    [
        pytest.param(77, 0.2, marks=pytest.mark.xfail(reason="its gap comes out 10 % too large", strict=True)),
        (87, 0.5),
    ],
)
def test_a_play_is_found_where_a_fit_along_derivatives_ends_beside_it(seed: int, rotor: float) -> None:
    """Whatever fraction of the inertia is the rotor's: an effect is looked for from 0.3."""
    rig = virtual_rig.Rig().drawn(seed)
    rig = dataclasses.replace(rig, backlash=0.1, rotor_share=rotor, force_noise=1e-3, torque_noise=3e-5)
    plans = virtual_rig.standard_plans(seed=seed + 1, sample_time=0.002, duration=2.0, free=1, forced=2, rest=1)
    recording = virtual_rig.record(rig, plans, seed=seed + 2)
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    setting = setting_of(fit, recording, [Backlash], Progress("diagnose", show=False))
    base = fit_base(setting)
    (play,) = screened_at_low_noise(setting, base)
    along, tried = refit_with(setting, base, play), refit_thoroughly(setting, base, play)
    assert tried.predictor.log_likelihood > along.predictor.log_likelihood + 100
    assert tried.added == ("backlash",)
    assert set(tried.free) == {*base.free, "backlash.gap", "backlash.rotor"}
    # What comes a sample early or late does not count for noise of the tachometer.
    assert 0.8 < np.exp(tried.predictor.noise[3]) < 1.3
    truth = {
        "backlash.gap": 0.1, "backlash.rotor": rotor, "torque_constant": rig.torque_constant,
        "spring_stiffness": rig.spring_stiffness, "eccentric_moment": rig.eccentric_moment,
    }  # fmt: skip
    for name, value in truth.items():
        assert tried.values[name] == pytest.approx(value, rel=0.05), name


def test_what_acts_on_the_arm_moves_a_contact() -> None:
    model = rtac.RTAC.paper()
    for effect in (CubicSpring(1e4), Cogging(1e-4, 0.0, 7.0), Backlash(0.1, 0.3), CurrentLag(0.01), TachoBias(0.1)):
        model = model + effect
    assert set(acting_on_arm(model, model.free)) == {
        "arm_inertia", "torque_constant", "arm_viscous.positive", "arm_viscous.negative", "cogging.cosine", "cogging.sine",
        "backlash.gap", "backlash.rotor", "current_lag.time_constant",
    }  # fmt: skip


def test_trials_begin_at_every_size_with_every_shape() -> None:
    begins = begins_of(Backlash(0.02, 0.3), ["gap"])
    gaps, rotors = {one["gap"] for one in begins}, {one["rotor"] for one in begins}
    assert min(gaps) == pytest.approx(0.01)
    assert max(gaps) == pytest.approx(0.16)
    assert min(rotors) == pytest.approx(0.1)
    assert max(rotors) == pytest.approx(0.8)
    assert len(begins) == len(gaps) * len(rotors)
    # A fraction of an inertia lies below one, so half as much again and more has no place.
    assert max(one["rotor"] for one in begins_of(Backlash(0.02, 0.7), ["gap"])) == pytest.approx(0.7)


def fit_of(likelihood: float) -> Refit:
    found = Refit.__new__(Refit)
    predictor = SimpleNamespace(log_likelihood=likelihood, noise=np.array([-9.0, -9.0, likelihood]))
    object.__setattr__(found, "predictor", predictor)
    return found


def space_of(likelihood: float) -> Space:
    """One that is known again by its only name."""
    found = Space.__new__(Space)
    object.__setattr__(found, "names", (str(likelihood),))
    return found


@pytest.mark.parametrize(
    ("likelihoods", "found", "sweeps"),
    [
        ([5000.0, 5005.0, 6000.0], 5005.0, 2),  # one that was not worth it
        ([5000.0, 6000.0, 5500.0, 7000.0], 6000.0, 3),
        ([None, 5000.0, 6000.0, None, 7000.0], 6000.0, 4),  # a fit that diverges ends nothing before there is one
        ([-5.0, -4.0], -5.0, 1),
        ([None] * 5, None, 5),
    ],
)
def test_sweeps_of_trials_end_with_the_likeliest_fit(
    likelihoods: list[float | None], found: float | None, sweeps: int
) -> None:
    begun: list[tuple[str, float]] = []
    left = iter(likelihoods)

    def climbed(space: Space, noise: np.ndarray, side: float) -> tuple[Space, np.ndarray]:
        begun.append((space.names[0], float(noise[2])))
        return space, noise

    def fitted(space: Space, noise: np.ndarray) -> tuple[Refit, Space]:
        likelihood = next(left)
        if likelihood is None:
            raise FloatingPointError("it diverges.")
        return fit_of(likelihood), space_of(likelihood)

    begin = space_of(0.0)
    if found is None:
        with pytest.raises(FloatingPointError, match="after all trials"):
            in_turn(begin, fit_of(0.0), climbed, fitted)
    else:
        assert in_turn(begin, fit_of(0.0), climbed, fitted).predictor.log_likelihood == found
    assert len(begun) == sweeps
    # Each begins where the likeliest fit before it ended.
    ended = [[one for one in likelihoods[:count] if one is not None] for count in range(sweeps)]
    assert begun == [(str(max(before, default=0.0)), max(before, default=0.0)) for before in ended]


def test_a_trial_looks_at_the_time_before_the_filter_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(contact_trials, "negative_log_likelihood", lambda *_: 1.0)
    cost, nothing = inspect.unwrap(contact_trials._cost), [None] * 7
    assert cost(*nothing) == 1.0
    with Deadline(0.0).kept(), pytest.raises(OutOfTimeError):
        cost(*nothing)


def test_where_the_time_is_over_the_likeliest_fit_so_far_counts() -> None:
    def climbed(space: Space, noise: np.ndarray, side: float) -> tuple[Space, np.ndarray]:
        if len(done) == late:
            raise OutOfTimeError
        return space, noise

    def fitted(space: Space, noise: np.ndarray) -> tuple[Refit, Space]:
        done.append(100.0 * (1 + len(done)))
        return fit_of(done[-1]), space_of(done[-1])

    for late in (1, 2):
        done: list[float] = []
        assert in_turn(space_of(0.0), fit_of(0.0), climbed, fitted).predictor.log_likelihood == 100.0 * late
    late, done = 0, []
    with pytest.raises(OutOfTimeError):
        in_turn(space_of(0.0), fit_of(0.0), climbed, fitted)
