"""Bias and scatter of the closed form over many experiments and recordings, and whether its stated deviations hold."""

import dataclasses

import numpy as np
import pytest
from closed_form_truth import RIG, TRUTH, every
from scipy.stats import t as student

import estimators as est
import rtac_jax as rtac
from estimators.closed_form.table1 import PAPER
from estimators.closed_form.two_stage import Estimates
from rtac_jax import virtual_rig


def scattered(seed: int) -> rtac.Recording:
    """Ten decays and twenty slow forced runs under random forces that scatter the estimates as much as Table 1 says.

    The paper's K_m scatters a fifth as much as its K_v, which needs currents below the cart's resonance: of faster ones,
    the arm's inertia takes nearly all, and K_v scatters fifteen times as much as K_m.
    """
    random = np.random.default_rng(seed)
    plans = virtual_rig.standard_plans(seed=seed, free=10, forced=20, rest=1, duration=10.0, sample_time=0.005)
    time = 0.005 * np.arange(2000)
    driven = []
    for number, plan in enumerate(p for p in plans if p.kind == "forced"):
        frequency, phase = random.uniform(0.5, 1.4, 6), random.uniform(0, 2 * np.pi, 6)
        current = np.sin(2 * np.pi * frequency[:, None] * time + phase[:, None]).sum(axis=0)
        current *= (
            0.1 * (0.5 + 0.5 * (number + 1) / 20) / np.sqrt(np.mean(current**2))
        )  # 50 to 100 %, as in section 4.2
        driven.append(dataclasses.replace(plan, current=current))
    idle = [dataclasses.replace(p, duration=min(p.duration, 5.0)) for p in plans if p.kind != "forced"]
    # The drive makes the random torque and shakes the cart too; in free oscillation it is off.
    jobs = [
        (dataclasses.replace(RIG, force_noise=2e-3), idle, seed),
        (dataclasses.replace(RIG, force_noise=4e-3, torque_noise=9e-4), driven, seed + 1000),
    ]
    parts = virtual_rig.record_many(jobs)
    return rtac.Recording(tuple(e for part in parts for e in part.experiments), rig=parts[0].rig)


@pytest.fixture(scope="module")
def papers_scatter() -> rtac.Recording:
    return scattered(2)


def test_scatter_comes_near_the_papers(papers_scatter: rtac.Recording) -> None:
    found = every(est.least_squares(rtac.RTAC.from_rig(papers_scatter), papers_scatter))
    ratio = {name: found[name].consistency / printed.consistency for name, printed in PAPER.items()}
    # No random force scatters me by the paper's 15.5 % without scattering v and d by more than the paper's 10 and 15 %.
    assert ratio.pop("eccentric_moment") < 1
    assert all(1 / 2 < r < 2 for r in ratio.values()), ratio


def biased(found: dict[str, Estimates]) -> dict[str, float]:
    """Standard deviations of the mean by which each estimate is off."""
    return {n: (found[n].value - t) / found[n].std for n, t in TRUTH.items()}


def predicted(recording: rtac.Recording) -> tuple[est.PredictorFit, dict[str, float]]:
    """Prediction error, and the standard deviations by which each parameter is off."""
    begin = est.least_squares(rtac.RTAC.from_rig(recording), recording, weak=True).model
    fit = est.prediction_error_nonlinear(begin, recording, from_model=True, progress=False)
    truth = {
        "spring_stiffness": RIG.spring_stiffness,
        "cart_viscous.coefficient": RIG.cart_viscous,
        "cart_coulomb.level": RIG.cart_coulomb,
        **{n: t for n, t in TRUTH.items() if n in fit.parameters},
    }
    return fit, {n: (fit.parameters[n].value - t) / fit.parameters[n].std for n, t in truth.items()}


@pytest.mark.slow  # notebook 02 asserts the same on one recording in every run
def test_what_biases_the_means_at_the_papers_scatter_is_removed(papers_scatter: rtac.Recording) -> None:
    model = rtac.RTAC.from_rig(papers_scatter)
    plain, better = (
        every(est.least_squares(model, papers_scatter)),
        every(est.least_squares(model, papers_scatter, weak=True)),
    )
    # The arm takes up a hundredth of the mass; counted, all of free oscillation comes within two deviations.
    assert biased(plain)["(M+m)/k"] < -3
    assert all(abs(biased(better)[n]) < 2 for n in ("(M+m)/k", "v/k", "d/k"))
    # A random torque drives the velocity that it disturbs, which hides a part of the arm's friction from least squares.
    fit, sigmas = predicted(papers_scatter)
    for name in ("arm_viscous.positive", "arm_viscous.negative"):
        assert better[name].pooled < 0.9 * TRUTH[name]
        assert fit.parameters[name].std < 0.06 * TRUTH[name]
        assert abs(sigmas[name]) < 2
    assert max(abs(s) for s in sigmas.values()) < 3, sigmas
    assert fit.torque_noise == pytest.approx(9e-4, rel=0.2)


@pytest.mark.slow
def test_prediction_error_keeps_the_means_within_two_deviations_over_many_recordings() -> None:
    sigmas = [list(predicted(scattered(seed))[1].values()) for seed in range(10, 22)]
    assert np.mean(np.abs(sigmas) < 2.0) > 0.85, np.round(sigmas, 1)


def coverage(runs: int) -> dict[str, float]:
    """Fraction of runs whose 95 % interval, by Student's distribution, holds the truth."""
    jobs = [
        (RIG, virtual_rig.standard_plans(seed=300 + i, sample_time=0.01, duration=5.0, free=6, forced=8, rest=1), i)
        for i in range(runs)
    ]
    hits: dict[str, list[bool]] = {name: [] for name in TRUTH}
    for recording in virtual_rig.record_many(jobs):
        found = every(est.least_squares(rtac.RTAC.from_rig(recording), recording, weak=True))
        for name, value in TRUTH.items():
            e = found[name]
            hits[name].append(bool(abs(e.value - value) < student.ppf(0.975, len(e.each) - 1) * e.std))
    return {name: float(np.mean(h)) for name, h in hits.items()}


@pytest.mark.slow
def test_stated_deviations_of_the_weak_form_cover_the_truth() -> None:
    found = coverage(16)
    assert np.mean(list(found.values())) > 0.85, found


@pytest.mark.slow
def test_stated_deviations_of_the_weak_form_cover_the_truth_in_many_runs() -> None:
    found = coverage(150)
    for name, share in found.items():
        # An error of 0.01 % that all experiments share shows in the stiffness, which scatters by less than that.
        assert share > (0.75 if name == "(M+m)/k" else 0.9), found
