"""Constants that were measured beforehand, with a standard deviation: estimated around it, and counted in all deviations."""

import dataclasses

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from rtac_jax import virtual_rig

RIG = virtual_rig.Rig().drawn(4)
OFF = 0.02  # the arm's inertia is known to this fraction, and off by it
TRUTH = {
    "arm_inertia": RIG.arm_inertia, "eccentric_moment": RIG.eccentric_moment, "torque_constant": RIG.torque_constant,
    "spring_stiffness": RIG.spring_stiffness, "arm_viscous.positive": RIG.arm_viscous_positive,
    "arm_viscous.negative": RIG.arm_viscous_negative,
}  # fmt: skip
PLANS = virtual_rig.standard_plans(seed=11, sample_time=0.005, duration=3.0, free=1, forced=2, rest=1)


@pytest.fixture(scope="module")
def off() -> rtac.Recording:
    """The arm's inertia is wrong, and said to be exact."""
    recording = virtual_rig.record(RIG, PLANS, seed=3)
    return dataclasses.replace(recording, rig={**recording.rig, "arm_inertia": (1 + OFF) * RIG.arm_inertia})


@pytest.fixture(scope="module")
def uncertain(off: rtac.Recording) -> rtac.Recording:
    """The same, with how sure the constants are."""
    return dataclasses.replace(off, rig_std={"arm_inertia": OFF * RIG.arm_inertia, "total_mass": 1e-4 * RIG.total_mass})


@pytest.fixture(scope="module")
def fitted(uncertain: rtac.Recording) -> est.Fit:
    return est.output_error(rtac.RTAC.from_rig(uncertain), uncertain, progress=False)


def deviations(found: est.Fit | est.PredictorFit) -> dict[str, float]:
    """Errors in standard deviations."""
    return {n: (found.parameters[n].value - truth) / found.parameters[n].std for n, truth in TRUTH.items()}


def test_model_of_a_recording_estimates_what_is_uncertain(off: rtac.Recording, uncertain: rtac.Recording) -> None:
    exact, model = rtac.RTAC.from_rig(off), rtac.RTAC.from_rig(uncertain)
    assert set(model.uncertain) == {"arm_inertia", "total_mass"} == exact.fixed
    assert not model.fixed
    assert exact.uncertain == ()
    assert set((model + rtac.effects.CubicSpring(1.0)).uncertain) == set(model.uncertain)
    assert model.fix("total_mass").uncertain == ("arm_inertia",)
    assert set(model.fix("total_mass").release("total_mass").uncertain) == set(model.uncertain)


def test_fit_finds_what_the_data_know_better_than_the_prior(fitted: est.Fit, off: rtac.Recording) -> None:
    known = fitted.parameters
    assert all(abs(d) < 4 for d in deviations(fitted).values()), deviations(fitted)
    assert known["arm_inertia"].std < 0.5 * OFF * RIG.arm_inertia
    # The data do not show the scale, which is as sure as the weighing.
    assert known["total_mass"].std == pytest.approx(1e-4 * RIG.total_mass, rel=0.01)
    assert known["spring_stiffness"].std > 0.99e-4 * known["spring_stiffness"].value
    held = est.output_error(rtac.RTAC.from_rig(off), off, progress=False)
    torque = held.parameters["torque_constant"]
    assert abs(torque.value - RIG.torque_constant) > 20 * torque.std
    assert torque.std < 0.1 * known["torque_constant"].std


def test_a_constant_that_the_fit_takes_far_from_what_was_measured_is_told(
    fitted: est.Fit, uncertain: rtac.Recording
) -> None:
    assert fitted.moved_constants == ()
    worse = {**uncertain.rig, "arm_inertia": 1.1 * RIG.arm_inertia}
    surer = dataclasses.replace(
        uncertain, rig=worse, rig_std={**uncertain.rig_std, "arm_inertia": 0.01 * RIG.arm_inertia}
    )
    found = est.output_error(rtac.RTAC.from_rig(surer), surer, progress=False)
    (said,) = found.moved_constants
    apart = (surer.rig["arm_inertia"] - found.parameters["arm_inertia"].value) / surer.rig_std["arm_inertia"]
    assert 4.0 < apart < 10.0  # of the ten between the truth and what is stated
    assert said.startswith(f"arm_inertia ended at {found.parameters['arm_inertia'].value:.4g}, {apart:.2g} stated")
    assert said in found.outcome


def test_predictions_count_the_constants_too(fitted: est.Fit, uncertain: rtac.Recording) -> None:
    found = est.prediction_error_nonlinear(fitted.model, uncertain, from_model=True, progress=False)
    assert all(abs(d) < 4 for d in deviations(found).values()), deviations(found)
    for name in ("arm_inertia", "total_mass", "torque_constant"):
        one, other = found.parameters[name], fitted.parameters[name]
        assert one.std == pytest.approx(other.std, rel=0.25), name
        assert one.value == pytest.approx(other.value, abs=other.std), name


def test_robust_covariances_count_the_constants(fitted: est.Fit, uncertain: rtac.Recording) -> None:
    found = est.covariances(fitted, uncertain)
    place = found.names.index("total_mass")
    for covariance in (found.plain, found.sandwich, found.clustered):
        assert np.sqrt(covariance[place, place]) == pytest.approx(1e-4 * RIG.total_mass, rel=0.02)
    np.testing.assert_allclose(np.diagonal(found.sandwich), np.diagonal(found.plain), rtol=0.5)


@pytest.mark.parametrize("weak", [False, True])
def test_closed_form_counts_the_constants(off: rtac.Recording, uncertain: rtac.Recording, weak: bool) -> None:
    exact = est.least_squares(rtac.RTAC.from_rig(off), off, weak=weak)
    found = est.least_squares(rtac.RTAC.from_rig(uncertain), uncertain, weak=weak)
    assert set(found.model.uncertain) == {"arm_inertia", "total_mass"}
    assert set(found.estimates) == set(exact.estimates)
    for name, one in found.estimates.items():
        assert one.value == exact.estimates[name].value
    for name in ("torque_constant", "arm_viscous.positive"):  # in proportion to the arm's inertia
        one, before = found.estimates[name], exact.estimates[name]
        assert one.std == pytest.approx(np.hypot(before.std, OFF / (1 + OFF) * one.value), rel=0.1)


def test_uncertain_starting_angle_is_estimated_as_far_as_its_deviation_allows(off: rtac.Recording) -> None:
    spreads = {}
    for std in (0.3, 1e-6):
        experiments = [dataclasses.replace(e, initial_arm_angle_std=std) for e in off if e.kind != "rest"]
        moved = [dataclasses.replace(e, initial_arm_angle=(e.initial_arm_angle or 0.0) + 0.2) for e in experiments]
        recording = dataclasses.replace(off, experiments=(*moved, off["rest_1"]))
        fit = est.output_error(rtac.RTAC.from_rig(off), recording, starts=1, progress=False)
        spreads[std] = max(abs(fit.start[e.name][2] - (e.initial_arm_angle or 0.0)) for e in moved)
    assert spreads[0.3] == pytest.approx(0.2, abs=0.05)
    assert spreads[1e-6] < 1e-3


@pytest.mark.slow
def test_closed_form_that_holds_a_constant_agrees_with_a_fit_that_estimates_it(
    fitted: est.Fit, uncertain: rtac.Recording
) -> None:
    """Else the inertia that is off by 2 %, which the fit knows to 0.4 %, would read as a failing of the model."""
    closed = est.least_squares(rtac.RTAC.from_rig(uncertain), uncertain, weak=True)
    moved = fitted.parameters["torque_constant"].value / closed.estimates["torque_constant"].pooled - 1
    assert abs(moved) > 0.005
    found = est.agreement([closed, fitted], uncertain, draws=40, progress=False)
    assert not found.rejected, found
    assert "torque_constant" in found.names


@pytest.mark.slow
def test_intervals_cover_where_the_constants_are_drawn() -> None:
    """The truth lies in 95 % intervals about as often as they say, and hardly ever where constants count as exact."""
    stds = {"arm_inertia": OFF * RIG.arm_inertia, "total_mass": 1e-3 * RIG.total_mass}
    plans = virtual_rig.standard_plans(seed=12, sample_time=0.005, duration=2.0, free=1, forced=2, rest=1)
    jobs = [(RIG, plans, 100 + seed) for seed in range(40)]
    inside: dict[bool, list[list[bool]]] = {True: [], False: []}
    for recording in virtual_rig.record_many(jobs, constants_std=stds):
        for counted in inside:
            one = recording if counted else dataclasses.replace(recording, rig_std={})
            start = rtac.RTAC.from_rig(one).with_values(
                {"spring_stiffness": RIG.spring_stiffness, "torque_constant": RIG.torque_constant}
            )
            found = est.output_error(start, one, from_model=True, progress=False)
            apart = [(found.parameters[n], truth) for n, truth in TRUTH.items() if n != "arm_inertia"]
            inside[counted].append([abs(p.value - truth) < 1.96 * p.std for p, truth in apart])
    covered = np.mean(inside[True], axis=0)
    assert np.all(covered > 0.84), covered  # of 40 at 0.95: less by chance in one of a thousand
    assert np.mean(np.mean(inside[False], axis=0)[1:3]) < 0.3, inside
