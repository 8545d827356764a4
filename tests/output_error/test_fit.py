"""Fits by simulation to noisy recordings of virtual rigs, what they refuse, and the parts that they are made of."""

import dataclasses
import re
import subprocess
import sys
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from exact_decay import MASS, STIFFNESS, TRUTH, exact_decay

import estimators as est
import rtac_jax as rtac
from estimators.core.data import Data
from estimators.core.fisher_information import information
from estimators.core.initial_state import space_of
from estimators.core.jacobian_factor import Arguments, factor
from estimators.core.residual import diagonal_whitener
from estimators.output_error import descent
from estimators.output_error.descent import Descent, DescentEnd
from rtac_jax import virtual_rig
from rtac_jax.effects import CATALOGUE


@pytest.fixture(scope="module")
def noisy() -> rtac.Recording:
    plans = virtual_rig.standard_plans(seed=11, sample_time=0.005, duration=6.0, free=2, forced=4, rest=1)
    return virtual_rig.record(virtual_rig.Rig(), plans, seed=12)


@pytest.fixture(scope="module")
def noisy_fit(noisy: rtac.Recording) -> est.Fit:
    return est.output_error(rtac.RTAC.from_rig(noisy), noisy, progress=False)


def test_noisy_estimates_agree_with_the_truth_within_their_deviations(
    noisy: rtac.Recording, noisy_fit: est.Fit
) -> None:
    fit = noisy_fit
    deviations = [(fit.parameters[n].value - v) / fit.parameters[n].std for n, v in TRUTH.items()]
    assert np.max(np.abs(deviations)) < 4.0, dict(zip(TRUTH, deviations, strict=True))
    assert np.sqrt(np.mean(np.square(deviations))) > 0.2  # deviations that never differ from zero are too wide
    assert fit.residual_std["cart_position"] == pytest.approx(2e-5, rel=0.1)
    assert fit.residual_std["arm_velocity"] == pytest.approx(0.05, rel=0.1)
    assert fit.parameters["total_mass"].std == 0.0
    closed = est.least_squares(rtac.RTAC.from_rig(noisy), noisy, reaction=True)
    for name, share in {"spring_stiffness": 0.01, "torque_constant": 0.01, "eccentric_moment": 0.1}.items():
        assert closed.estimates[name].pooled == pytest.approx(TRUTH[name], rel=share), name

    train = est.compare(fit, noisy).models[0]
    assert train.errors["cart_position"].rms_over_noise == pytest.approx(1.0, abs=0.15)
    assert train.errors["arm_velocity"].fit_percent > 95.0


def test_a_start_that_is_far_off_does_not_hide_what_the_data_show() -> None:
    """The closed form of two short decays puts the dry friction on its bound, from where a simulation misses by much."""
    rig = virtual_rig.Rig(cart_coulomb=1.5e-3)
    decays = [
        virtual_rig.Plan(f"free_{n}", "free", 2.5, 0.01, initial_position=x, initial_angle=np.pi / 2)
        for n, x in enumerate((6e-3, 12e-3))
    ]
    recording = virtual_rig.record(rig, [*decays, virtual_rig.Plan("rest_1", "rest", 1.0, 0.01)], seed=100)
    model = rtac.RTAC.from_rig(recording)
    asked = ("cart_coulomb.level", "spring_stiffness", "cart_viscous.coefficient")
    fit = est.output_error(model.fix(*[n for n in model.free if n not in asked]), recording, progress=False)
    level = fit.parameters["cart_coulomb.level"]
    assert level.std < 0.1 * rig.cart_coulomb
    assert abs(level.value - rig.cart_coulomb) < 4 * level.std


def test_a_fit_that_a_kink_stopped_says_so(noisy_fit: est.Fit) -> None:
    stopped = dataclasses.replace(noisy_fit, statistics={**noisy_fit.statistics, "promised": 21.7})
    assert "kink" in stopped.outcome
    assert "still promise 22 in log-likelihood" in str(stopped)
    assert "kink" not in str(noisy_fit)
    moving = dataclasses.replace(stopped, result=est.RESULTS.steps_exhausted).outcome
    assert "still promise 22" in moving
    assert "kink" not in moving, "it has not come to rest"
    bound = dataclasses.replace(
        noisy_fit,
        result=est.RESULTS.pulled_off_bound,
        statistics={**noisy_fit.statistics, "pulled": ("cart_coulomb.level",)},
    )
    assert " That is cart_coulomb.level." in bound.outcome
    nearly = dataclasses.replace(
        stopped, result=est.RESULTS.steps_exhausted, statistics={**stopped.statistics, "promised": 0.06}
    )
    assert "By their slopes the best is likelier by 0.06 only, and lies within 0.4 of the deviations." in nearly.outcome
    far = dataclasses.replace(nearly, residual_std={c: 40.0 * s for c, s in nearly.noise.items()})
    assert "By their slopes" not in far.outcome
    robust = dataclasses.replace(nearly, weights={"free_1": np.ones((2, 3))})
    assert "By their slopes" not in robust.outcome, "its weights would move, too"


@pytest.mark.parametrize("led", [True, False])
def test_where_models_are_only_ranked_no_predictions_lead(
    noisy_fit: est.Fit, noisy: rtac.Recording, led: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    monkeypatch.setattr(Descent, "_guided", lambda *_: asked.append(1))
    mosts, ended = [], Descent._ended

    def noted(*given: Any, most: int | None = None) -> DescentEnd:
        mosts.append(most)
        return ended(*given, most=most)

    monkeypatch.setattr(Descent, "_ended", noted)
    monkeypatch.setattr(descent, "_NEAR_NOISE", 1.02)  # or else it would be near enough to need no predictions
    monkeypatch.setattr(descent, "_NEAR_MOTION", 10.0)
    monkeypatch.setattr(descent, "_UNLED_STEPS", 1)
    values = {n: 1.3 * float(noisy_fit.model[n]) for n in ("cart_coulomb.level", "cart_viscous.coefficient")}
    found = est.output_error(
        noisy_fit.model.with_values(values), noisy, from_model=True, steps=1, led=led, progress=False
    )
    assert found.result == est.RESULTS.steps_exhausted
    assert bool(asked) == led
    assert led or found.statistics["steps"] <= 2
    # The first descent from the values: in the steps that were allowed, or in the few before predictions lead.
    assert mosts[0] == (1 if led else None)


@pytest.mark.slow
def test_a_fit_whose_steps_run_out_far_from_its_end_goes_on_from_there() -> None:
    """One step is all that is allowed after the start; the start that is led anew counts as the same one."""
    plans = virtual_rig.standard_plans(seed=7, sample_time=0.005, duration=8.0, free=1, forced=2, rest=1)
    recording = virtual_rig.record(virtual_rig.Rig(arm_coulomb=2e-4), plans, seed=8)
    model = rtac.RTAC.from_rig(recording)
    one, all_of_them = (est.output_error(model, recording, steps=steps, starts=1, progress=False) for steps in (1, 60))
    # Alone the one step leaves 46 more than all steps do, and slopes that promise 44.
    assert one.statistics["cost"] < all_of_them.statistics["cost"] + 40.0
    assert one.statistics["agreed"] == one.statistics["starts"] == 1
    assert "did not converge" in one.outcome


@pytest.mark.slow
def test_starts_that_no_sensor_could_tell_apart_are_followed_once(
    noisy: rtac.Recording, noisy_fit: est.Fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Starts far off are guided by predictions; where one then simulates what another did, the rest would be the same."""
    four = est.output_error(rtac.RTAC.from_rig(noisy), noisy, starts=4, progress=False)
    assert four.statistics["agreed"] == four.statistics["starts"] == 4
    assert four.result == est.RESULTS.successful
    assert four.statistics["cost"] == noisy_fit.statistics["cost"]
    monkeypatch.setattr(Descent, "_followed", lambda *_: None)
    whole = est.output_error(rtac.RTAC.from_rig(noisy), noisy, starts=4, progress=False)
    assert whole.statistics["agreed"] == 4
    more, going_on = (one.statistics["steps"] - noisy_fit.statistics["steps"] for one in (four, whole))
    assert more < 0.6 * going_on, (more, going_on)
    assert four.statistics["cost"] == pytest.approx(whole.statistics["cost"], abs=1e-3)


def test_starts_do_not_vouch_for_a_model_that_does_not_follow_the_rig(noisy_fit: est.Fit) -> None:
    """Two starts that agreed at 1,023 times the noise were left behind by a third."""
    assert noisy_fit.outcome.endswith("starts agree.")
    assert noisy_fit.statistics["promised"] < 0.01
    near, far = (
        dataclasses.replace(
            noisy_fit, residual_std={**noisy_fit.residual_std, "arm_velocity": times * noisy_fit.noise["arm_velocity"]}
        )
        for times in (9.9, 1023.0)
    )
    assert near.outcome == noisy_fit.outcome
    doubt = (
        "The model does not follow the rig, arm_velocity being left at 1,023 times its noise: there the sum of squares"
    )
    assert doubt in str(far)
    cut = dataclasses.replace(far, statistics={**far.statistics, "in_pieces": True})
    assert (far.in_pieces, cut.in_pieces) == (False, True)
    assert "1,023 times its noise in pieces of long experiments that begin anew, more in a whole one:" in str(cut)


@pytest.mark.slow
def test_starts_that_simulate_something_else_are_followed_to_their_ends() -> None:
    """As on a rig that random forces shake: what a simulation leaves has many valleys."""
    plans = virtual_rig.standard_plans(seed=11, sample_time=0.005, duration=4.0, free=2, forced=2, rest=1)
    shaken = virtual_rig.record(virtual_rig.Rig(force_noise=0.1), plans, seed=12)
    one, two = (
        est.output_error(rtac.RTAC.from_rig(shaken), shaken, starts=starts, progress=False).statistics
        for starts in (1, 2)
    )
    assert two["steps"] > 1.4 * one["steps"], (one, two)
    assert two["cost"] <= one["cost"]


def test_with_noise_weak_closed_form_output_error_and_truth_agree(noisy: rtac.Recording, noisy_fit: est.Fit) -> None:
    """Within four of their standard deviations, which are small enough to say something: a hundredth and a thousandth.

    The scatter of two decays is a standard deviation of one degree of freedom: on other recordings it may well be far too small.
    """
    closed = est.least_squares(rtac.RTAC.from_rig(noisy), noisy, weak=True).estimates
    assert closed.keys() == TRUTH.keys()
    for name, value in TRUTH.items():
        here, there = closed[name], noisy_fit.parameters[name]
        assert here.std < 1e-2 * value, name
        assert there.std < 1e-3 * value, name
        assert abs(here.value - value) < 4 * here.std, name
        assert abs(there.value - value) < 4 * there.std, name
        assert abs(here.value - there.value) < 4 * np.hypot(here.std, there.std), name


@pytest.mark.slow
def test_a_rig_without_known_constants_is_refused_with_the_free_combination(noisy: rtac.Recording) -> None:
    unknown = rtac.Recording(noisy.experiments)
    with pytest.raises(
        est.NotIdentifiableError, match=r"free: .*total_mass.*scaled together.*Give total_mass or arm_inertia in /rig"
    ):
        est.output_error(rtac.RTAC.from_rig(unknown), unknown, progress=False, starts=1)


def test_a_model_that_diverges_is_refused(noisy: rtac.Recording) -> None:
    model = rtac.RTAC.from_rig(noisy) + rtac.effects.CubicSpring(-1e9)
    with pytest.raises(est.DivergedError, match="diverges at the start values"):
        est.output_error(model, noisy, progress=False, from_model=True)


def test_comparison_with_a_model_that_diverges_names_model_and_experiment(
    noisy: rtac.Recording, noisy_fit: est.Fit
) -> None:
    # Tonnes for kilograms: the arm is heavier than the cart that carries it.
    lost = dataclasses.replace(noisy_fit, model=noisy_fit.model.with_values({"total_mass": 1.23e-3}))
    with pytest.raises(est.DivergedError, match=r"experiment free_1: the model 'tonnes' diverges .*check .* unit"):
        est.compare([noisy_fit, lost], noisy, labels=["good", "tonnes"])


def test_another_recording_with_the_same_names_has_starts_of_its_own(noisy: rtac.Recording, noisy_fit: est.Fit) -> None:
    plans = virtual_rig.standard_plans(seed=77, sample_time=0.01, duration=3.0, free=2, forced=4, rest=1)
    other = virtual_rig.record(virtual_rig.Rig(), plans, seed=78)
    assert other.names == noisy.names
    for error in est.compare(noisy_fit, other).models[0].errors.values():
        assert error.rms_over_noise < 1.3
    with pytest.raises(ValueError, match="other measurements than this recording holds; give the recording"):
        est.covariances(noisy_fit, other)


def test_comparison_names_the_one_experiment_that_a_model_leaves() -> None:
    """A softening spring lets go beyond 12 mm, where only the second decay begins."""
    time = 0.01 * np.arange(200)
    recording = rtac.Recording(
        tuple(
            rtac.Experiment.of(
                f"from_{1000 * q:g}_mm", kind="free", sample_time=0.01, arm="locked", initial_arm_angle=0.0,
                cart_position=exact_decay(q, time),
            )
            for q in (0.006, 0.015, 0.01)
        ),
        rig={"total_mass": MASS},
    )  # fmt: skip
    model = rtac.RTAC.from_rig(recording).with_values({"spring_stiffness": STIFFNESS})
    soft = model + rtac.effects.CubicSpring(-STIFFNESS / 0.012**2)
    with pytest.raises(est.DivergedError, match=r"experiment from_15_mm: the model 'model' diverges"):
        est.compare(soft, recording)


def test_what_free_decays_do_not_show_is_refused_by_name() -> None:
    """A drive that is idle; and a pull at a spring, which a sensor that is shifted shows just as well."""
    time = 0.01 * np.arange(200)
    experiments = tuple(
        rtac.Experiment.of(
            f"free_{i}", kind="free", sample_time=0.01, arm="locked", initial_arm_angle=0.0,
            cart_position=exact_decay(q, time), noise_std={"cart_position": 1e-6},
        )
        for i, q in enumerate((0.015, -0.01))
    )  # fmt: skip
    recording = rtac.Recording(experiments, rig={"total_mass": MASS})
    model = rtac.RTAC.from_rig(recording).without("cart_coulomb") + rtac.effects.CurrentLag(0.003)
    model = model + rtac.effects.ForceOffset(0.01) + rtac.effects.LvdtOffset(1e-4)
    with pytest.raises(est.NotIdentifiableError, match=r"leave 2 combination") as refusal:
        est.output_error(model, recording, progress=False, starts=1)
    assert "current_lag.time_constant has no effect on what was measured" in str(refusal.value)
    pair = r"force_offset\.offset, lvdt_offset\.offset may be (scaled together|traded against each other)"
    assert re.search(pair, str(refusal.value))
    assert "spring_stiffness" not in str(refusal.value)  # nor anything else that these decays show well


def test_nothing_moves_and_nothing_free_are_refused(noisy: rtac.Recording) -> None:
    resting = rtac.Recording(tuple(e for e in noisy.experiments if e.kind == "rest"), rig=noisy.rig)
    with pytest.raises(ValueError, match="rest records only"):
        est.output_error(rtac.RTAC.paper(), resting, progress=False)
    model = rtac.RTAC.from_rig(noisy)
    with pytest.raises(ValueError, match="no free parameter"):
        est.output_error(model.fix(*model.free), noisy, progress=False)


def test_estimation_refuses_single_precision() -> None:
    code = (
        "import rtac_jax as r, estimators as e\n"
        "x = r.Recording((r.Experiment.of('a', kind='free', sample_time=0.1, cart_position=[0., 1] * 8),))\n"
        "e.output_error(r.RTAC.paper(), x)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "rtac_jax.configure()" in done.stderr


def test_a_parameter_of_each_experiment_is_estimated_for_each(noisy: rtac.Recording) -> None:
    biased = []
    for number, e in enumerate(noisy.experiments):
        shift = 0.0 if e.kind == "rest" else 0.1 * number
        values = {c: s.values + (shift if c == "arm_velocity" else 0.0) for c, s in e.outputs.items()}
        current = e.inputs["current"].values if "current" in e.inputs else None
        biased.append(
            rtac.Experiment.of(
                e.name,
                kind=e.kind,
                sample_time=e.sample_time,
                current=current,
                initial_arm_angle=e.initial_arm_angle,
                **values,
            )
        )
    recording = rtac.Recording(tuple(biased), rig=noisy.rig)
    model = (rtac.RTAC.from_rig(recording) + rtac.effects.TachoBias(0.0)).each_experiment("tacho_bias.bias")
    fit = est.output_error(model, recording, progress=False, starts=1)
    expected = [0.1 * i for i, e in enumerate(noisy.experiments) if e.kind != "rest"]
    np.testing.assert_allclose(np.asarray(fit.model["tacho_bias.bias"]), expected, atol=0.02)


def test_the_compressed_residual_keeps_squares_and_gradients(noisy: rtac.Recording) -> None:
    experiments = [e.cut(0, 200, e.name) for e in noisy.experiments if e.kind != "rest"][:3]
    model = rtac.RTAC.paper()
    data = Data.of(experiments)
    space = space_of(model, experiments, free=["spring_stiffness", "torque_constant"])
    unknowns = space.unconstrained()
    white = diagonal_whitener(np.array([2e-5, 0.05, 1.0]), data)
    arguments = Arguments(model, data, space, white, None, 1)
    compact = np.asarray(factor(unknowns, arguments))

    def rows(shared: np.ndarray, column: int) -> np.ndarray:
        from estimators.core.jacobian_factor import plain_residual

        error, known = plain_residual(unknowns._replace(shared=jnp.asarray(shared)), arguments)
        return np.concatenate([np.asarray(error)[:, :, column].ravel(), np.asarray(known)[:, column]])

    here = np.asarray(unknowns.shared)
    for column in range(3):
        step = 1e-6
        jacobian = np.stack(
            [(rows(here + step * e, column) - rows(here - step * e, column)) / (2 * step) for e in np.eye(2)], axis=1
        )
        whole = np.concatenate([jacobian, rows(here, column)[:, None]], axis=1)
        part = compact[column][:, [0, 1, -1]]
        np.testing.assert_allclose(part.T @ part, whole.T @ whole, rtol=2e-4)


def test_covariance_integrates_the_starts_out(noisy: rtac.Recording) -> None:
    """The covariance of the shared parameters is that of a dense least squares over everything."""
    experiments = [e.cut(0, 300, e.name) for e in noisy.experiments if e.kind != "rest"][:3]
    model = rtac.RTAC.paper()
    data = Data.of(experiments)
    space = space_of(model, experiments, free=["spring_stiffness", "cart_viscous.coefficient"])
    unknowns = space.unconstrained()
    arguments = Arguments(model, data, space, diagonal_whitener(np.array([2e-5, 0.05, 1.0]), data), None, 1)
    compact = np.asarray(factor(unknowns, arguments))
    found = information(compact, space, unknowns)
    own = compact.shape[2] - 3
    dense = np.zeros((3 * compact.shape[1], 2 + 3 * own))
    for i, block in enumerate(compact):
        rows = slice(i * compact.shape[1], (i + 1) * compact.shape[1])
        dense[rows, :2] = block[:, :2]
        dense[rows, 2 + i * own : 2 + (i + 1) * own] = block[:, 2:-1]
    covariance = np.linalg.inv(dense.T @ dense)[:2, :2]
    z = np.asarray(unknowns.shared)
    slope = np.asarray(space.scale)[np.asarray(space.active)] * 0.5 * (1 + z / np.sqrt(z * z + 4))
    np.testing.assert_allclose(found.covariance, covariance * np.outer(slope, slope), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("yields_at", [5e-6, 1e-5])
def test_what_only_a_correcting_filter_makes_diverge_is_fitted_by_simulation(yields_at: float) -> None:
    """Stiff bristles beside a filter that follows a sensor of 4 um, sample by sample: the filter swings up, the rig does not."""
    rig = virtual_rig.Rig(
        cart_coulomb=0.25, spring_stiffness=900.0, total_mass=2.4, position_noise=4e-6, position_range=0.03, quantisation_bits=16,
    )  # fmt: skip
    plans = virtual_rig.standard_plans(seed=1, sample_time=1e-3, duration=1.5, free=2, forced=0)
    recorded = virtual_rig.record(rig, [dataclasses.replace(plan, arm="locked") for plan in plans], seed=3)
    cart = [dataclasses.replace(e, outputs={"cart_position": e.outputs["cart_position"]}) for e in recorded]
    recording = rtac.Recording(cart, {"total_mass": rig.total_mass})
    model = rtac.RTAC.from_rig(recording).with_values(
        {"spring_stiffness": 900.0, "cart_viscous.coefficient": 0.55, "cart_coulomb.level": 0.2}
    )
    fit = est.output_error(
        model + CATALOGUE["cart_presliding"](0.1, yields_at), recording, from_model=True, progress=False
    )
    assert fit.farthest < 1.1
    assert fit.parameters["spring_stiffness"].value == pytest.approx(900.0, rel=1e-3)
