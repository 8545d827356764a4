"""Prediction error of the nonlinear model against the virtual rig, shaken by random forces."""

import importlib

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from estimators.prediction_error import filter_pass, noise_estimation
from estimators.prediction_error.filter_pass import negative_log_likelihood, run_filter, score_noise
from rtac_jax.virtual_rig import Rig, record, standard_plans


@pytest.fixture(scope="module")
def shaken():
    """A rig without dry friction under random forces and torques, its truth, and the model's values when nothing is known."""
    rig = Rig(encoder=True, cart_coulomb=0.0, force_noise=0.01, torque_noise=5e-5)
    plans = standard_plans(seed=1, sample_time=0.01, duration=8.0, free=3, forced=4, rest=1)
    data = record(rig, plans, seed=2)
    truth = {
        "spring_stiffness": rig.spring_stiffness,
        "cart_viscous.coefficient": rig.cart_viscous,
        "eccentric_moment": rig.eccentric_moment,
        "torque_constant": rig.torque_constant,
        "arm_viscous.positive": rig.arm_viscous_positive,
        "arm_viscous.negative": rig.arm_viscous_negative,
    }
    return data, rtac.RTAC.from_rig(data).without("cart_coulomb"), truth, rig


def away(fit, truth):
    return {name: (fit.parameters[name].value - value) / fit.parameters[name].std for name, value in truth.items()}


@pytest.mark.slow
def test_random_forces_do_not_bend_the_physics(shaken):
    data, model, truth, rig = shaken
    simulated_fit = est.output_error(model, data, progress=False)
    found = est.prediction_error_nonlinear(model, data, progress=False)
    # Of what is fitted by simulation, at least one parameter is farther off than ten of its standard deviations.
    assert max(abs(x) for x in away(simulated_fit, truth).values()) > 10
    assert max(abs(x) for x in away(found, truth).values()) < 3
    assert found.force_noise == pytest.approx(rig.force_noise, rel=0.15)
    assert found.torque_noise == pytest.approx(rig.torque_noise, rel=0.15)
    assert found.noise["arm_angle"] == pytest.approx(rig.angle_noise, rel=0.1)
    assert np.mean([w.p_value > 0.01 for w in found.whiteness]) > 0.9
    assert all(0.8 < w.rms < 1.2 for w in found.whiteness)
    assert "white" in str(found)
    assert "white" in found.plot()._suptitle.get_text()


@pytest.mark.slow
def test_the_curvature_of_the_noise_is_that_of_its_likelihood(shaken):
    """At the estimate, beside central differences of the slope; expected and observed curvature differ by chance only."""
    data, model, _, _ = shaken
    found = est.prediction_error_nonlinear(model, data, progress=False, rounds=2)
    a, at = found.problem.arguments, found.noise_exponents
    physical = a.space.physical(found.problem.unknowns)

    def passed(noise):
        return score_noise(a.model, a.data, a.space, physical, found.prior, noise, a.substeps)

    step = 1e-3
    observed = [(passed(at + d).slope() - passed(at - d).slope()) / (2 * step) for d in step * np.eye(5)]
    alone = negative_log_likelihood(a.model, a.data, a.space, physical, found.prior, at, a.substeps)
    assert alone == pytest.approx(passed(at).value, rel=1e-12)
    expected = passed(at).curvature().information
    size = np.sqrt(np.diagonal(expected))
    np.testing.assert_allclose(np.array(observed) / np.outer(size, size), expected / np.outer(size, size), atol=0.1)
    # Where the noise is likeliest, less than a tenth is to be gained by a step.
    slope = passed(at).slope() + np.concatenate([np.zeros(2), at[2:] / found.prior.doubt**2])
    assert slope @ np.linalg.solve(expected, slope) < 0.2


@pytest.mark.slow
def test_a_filter_of_long_experiments_is_the_same(shaken, monkeypatch):
    data, model, _, _ = shaken
    found = est.prediction_error_nonlinear(model, data, progress=False, rounds=2)
    a = found.problem.arguments
    given = (a.model, a.data, a.space, a.space.physical(found.problem.unknowns), found.prior, found.noise_exponents)
    whole = run_filter(*given, a.substeps)
    monkeypatch.setattr(filter_pass, "LONG", 1)
    for name, value in run_filter(*given, a.substeps)._asdict().items():
        size = np.max(np.abs(np.asarray(value)))
        np.testing.assert_allclose(value, getattr(whole, name), rtol=0, atol=1e-12 * size, err_msg=name)


@pytest.mark.slow
def test_a_curvature_that_is_kept_changes_steps_and_not_where_they_end(shaken, monkeypatch):
    data, model, _, _ = shaken
    computed: list[int] = []
    information = filter_pass._information

    def counted(*given):
        computed[-1] += 1
        return information(*given)

    monkeypatch.setattr(filter_pass, "_information", counted)
    ends = []
    for near in (filter_pass._NEAR, -1.0):  # never kept
        monkeypatch.setattr(filter_pass, "_NEAR", near)
        computed.append(0)
        ends.append(est.prediction_error_nonlinear(model, data, progress=False))
    kept, anew = ends
    assert computed[0] < computed[1]
    assert kept.log_likelihood == pytest.approx(anew.log_likelihood, abs=0.2)
    for name, parameter in kept.parameters.items():
        assert parameter.value == pytest.approx(anew.parameters[name].value, abs=0.05 * parameter.std), name


def test_noise_that_a_part_tells_first_is_that_of_all_samples(shaken, monkeypatch):
    data, model, _, _ = shaken
    found = est.prediction_error_nonlinear(model, data, progress=False, rounds=2)
    a = found.problem.arguments
    physical = a.space.physical(found.problem.unknowns)
    lengths: list[int] = []

    def counted(model, data, *others):
        lengths.append(data.samples)
        return score_noise(model, data, *others)

    monkeypatch.setattr(noise_estimation, "score_noise", counted)
    noise = {}
    for fewest in (50, 10**9):
        monkeypatch.setattr(noise_estimation, "_FEWEST", fewest)
        noise[fewest] = noise_estimation.fit_noise(a.model, a.data, a.space, physical, found.prior, None, a.substeps)
    part = a.data.samples // noise_estimation._PART
    assert part in lengths
    assert set(lengths) == {part, a.data.samples}
    assert noise[50].log_likelihood == pytest.approx(noise[10**9].log_likelihood, abs=0.2)
    # Far from a bound, where the likelihood tells them.
    told = noise[50].exponents > -15
    np.testing.assert_allclose(noise[50].exponents[told], noise[10**9].exponents[told], atol=0.05)


@pytest.mark.slow
def test_a_parameter_of_each_condition_beside_shared_ones(shaken):
    data, model, truth, _ = shaken
    found = est.prediction_error_nonlinear(
        model.each_experiment("cart_viscous.coefficient"), data, progress=False, from_model=True
    )
    values = np.asarray(found.model["cart_viscous.coefficient"])
    std = found.each_std["cart_viscous.coefficient"]
    assert values.shape == std.shape == (7,)
    sigmas = (values - truth["cart_viscous.coefficient"]) / std
    assert np.max(np.abs(sigmas)) < 3.5
    # Seven values of one truth: their chi-square lies within its 99.8 % range.
    assert 0.6 < np.sum(sigmas**2) < 24.3
    shared = {name: value for name, value in truth.items() if name != "cart_viscous.coefficient"}
    assert max(abs(x) for x in away(found, shared).values()) < 3
    assert "cart_viscous.coefficient[forced_1]" in str(found)


def test_nothing_to_fit_is_refused(shaken):
    data, model, _, _ = shaken
    with pytest.raises(ValueError, match="no free parameter"):
        est.prediction_error_nonlinear(model.fix(*model.free), data)
    resting = data.select([e.name for e in data if e.kind == "rest"])
    with pytest.raises(ValueError, match="rest records only"):
        est.prediction_error_nonlinear(model, resting)


@pytest.mark.slow
def test_a_singular_matrix_is_told_in_words(shaken, monkeypatch):
    """The library's "Singular matrix" had been the whole sentence, of a servo arm that fell in 98 samples."""
    data, model, _, _ = shaken

    def singular(*_, **__):
        raise np.linalg.LinAlgError("Singular matrix")

    module = importlib.import_module("estimators.prediction_error.fit")  # a function hides the package
    monkeypatch.setattr(module, "fit_trusted", singular)
    with pytest.raises(est.DivergedError, match="leave some parameter without any effect: the model follows next to"):
        est.prediction_error_nonlinear(model, data, from_model=True, progress=False)


@pytest.mark.slow
def test_random_forces_do_not_bend_dry_friction():
    """With the samples counted at which they shake it loose its level is 6 standard deviations low, and damping 4 high."""
    rig = Rig(encoder=True, force_noise=0.005, torque_noise=5e-5)
    data = record(rig, standard_plans(seed=1, sample_time=0.01, duration=8.0, free=3, forced=4, rest=1), seed=1)
    found = est.prediction_error_nonlinear(rtac.RTAC.from_rig(data), data, progress=False)
    truth = {
        "cart_coulomb.level": rig.cart_coulomb, "cart_viscous.coefficient": rig.cart_viscous,
        "spring_stiffness": rig.spring_stiffness, "eccentric_moment": rig.eccentric_moment,
    }  # fmt: skip
    assert max(abs(x) for x in away(found, truth).values()) < 3
    counted = found.statistics["samples"] / sum(e.samples * len(e.outputs) for e in data if e.kind != "rest")
    assert 0.5 < counted < 0.98, "some samples are left out, and not most"
