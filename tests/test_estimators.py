"""Closed form, output error, noise, filter and covariance against truths that do not come from the package's model."""

import subprocess
import sys

import control
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import estimators as est
import rtac_jax as rtac
from estimators._covariance import information, information_of
from estimators._kalman import filtered
from estimators._levenberg_marquardt import Arguments, factor
from estimators._noise import noise_levels, quantisation_step, spectral_floor
from estimators._output_error import diagonal_whitener
from estimators._problem import Data
from estimators._start import space_of
from estimators._transform import to_physical, to_unconstrained
from rtac_jax import virtual_rig

MASS, STIFFNESS, VISCOUS = 1.23, 132.6, 0.5543  # paper, section 4.2


def exact_decay(position: float, time: np.ndarray) -> np.ndarray:
    """A damped oscillator let go from rest, in closed form."""
    rate = VISCOUS / (2 * MASS)
    damped = np.sqrt(STIFFNESS / MASS - rate**2)
    return position * np.exp(-rate * time) * (np.cos(damped * time) + rate / damped * np.sin(damped * time))


@pytest.fixture(scope="module")
def smooth_decays() -> rtac.Recording:
    time = 2e-4 * np.arange(15000)
    experiments = [
        rtac.Experiment.of(
            f"free_{i}", kind="free", sample_time=2e-4, cart_position=exact_decay(q, time), arm="locked",
            initial_arm_angle=0.0, noise_std={"cart_position": 1e-9},
        )
        for i, q in enumerate((0.015, 0.01, 0.006))
    ]  # fmt: skip
    return rtac.Recording(tuple(experiments), rig={"total_mass": MASS})


def test_closed_form_without_noise_gives_the_truth(smooth_decays: rtac.Recording) -> None:
    model = rtac.RTAC.from_rig(smooth_decays).without("cart_coulomb")
    found = est.least_squares(model, smooth_decays)
    assert found.ratios["(M+m)/k"].pooled == pytest.approx(MASS / STIFFNESS, rel=1e-6)
    assert found.estimates["spring_stiffness"].pooled == pytest.approx(STIFFNESS, rel=1e-6)
    assert found.estimates["cart_viscous.coefficient"].pooled == pytest.approx(VISCOUS, rel=1e-5)
    assert found.ratios["(M+m)/k"].consistency < 1e-5
    assert "total_mass" not in found.estimates  # it was known


def test_output_error_without_noise_gives_the_truth_and_the_closed_form(smooth_decays: rtac.Recording) -> None:
    model = rtac.RTAC.from_rig(smooth_decays).without("cart_coulomb")
    fit = est.output_error(model, smooth_decays, progress=False, tolerance=1e-10)
    assert float(fit.model["spring_stiffness"]) == pytest.approx(STIFFNESS, rel=1e-6)
    assert float(fit.model["cart_viscous.coefficient"]) == pytest.approx(VISCOUS, rel=1e-6)
    closed = est.least_squares(model, smooth_decays)
    assert float(fit.model["spring_stiffness"]) == pytest.approx(closed.estimates["spring_stiffness"].pooled, rel=1e-6)


@pytest.fixture(scope="module")
def smooth_forced() -> rtac.Recording:
    """Free and forced runs of a rig with viscous friction only, by an adaptive integrator, without noise."""
    mass, inertia, moment, torque, friction = MASS, 9.5e-5, 1.06e-3, 0.0804, 1.4e-4
    random = np.random.default_rng(5)
    dt, count = 0.01, 400
    time = dt * np.arange(count)

    def slope(_: float, x: np.ndarray, current: float) -> list[float]:
        q, v, angle, w = x
        matrix = np.array([[mass, moment * np.cos(angle)], [moment * np.cos(angle), inertia]])
        force = [-STIFFNESS * q - VISCOUS * v + moment * w**2 * np.sin(angle), torque * current - friction * w]
        a, b = np.linalg.solve(matrix, force)
        return [v, a, w, b]

    experiments = []
    for number, start in enumerate(([0.01, 0.0, 0.4, 0.0], [0.0, 0.0, -0.7, 0.0], [0.004, 0.0, 1.2, 0.0])):
        phases = random.uniform(0, 2 * np.pi, 5)
        current = sum(
            0.08 * np.sin(2 * np.pi * f * time + p) for f, p in zip((1.2, 1.7, 2.3, 3.1, 4.0), phases, strict=True)
        )
        current = current - current[0] if number else 0.0 * current
        x, rows = np.array(start), []
        for k in range(count):
            rows.append(x)
            x = solve_ivp(slope, (0, dt), x, "DOP853", args=(current[k],), rtol=1e-11, atol=1e-14).y[:, -1]
        table = np.array(rows)
        experiments.append(
            rtac.Experiment.of(
                f"run_{number}", kind="forced" if number else "free", sample_time=dt, current=current,
                cart_position=table[:, 0], arm_velocity=table[:, 3], arm_angle=table[:, 2], initial_arm_angle=start[2],
                noise_std={"cart_position": 1e-8, "arm_velocity": 1e-4, "arm_angle": 1e-6},
            )
        )  # fmt: skip
    return rtac.Recording(tuple(experiments), rig={"total_mass": mass, "arm_inertia": inertia})


def test_forced_output_error_without_noise_gives_the_truth(smooth_forced: rtac.Recording) -> None:
    model = rtac.RTAC.from_rig(smooth_forced).without("cart_coulomb")
    fit = est.output_error(model, smooth_forced, progress=False, tolerance=1e-10)
    truth = {
        "spring_stiffness": STIFFNESS, "cart_viscous.coefficient": VISCOUS, "eccentric_moment": 1.06e-3,
        "torque_constant": 0.0804, "arm_viscous.positive": 1.4e-4, "arm_viscous.negative": 1.4e-4,
    }  # fmt: skip
    for name, value in truth.items():
        assert float(fit.model[name]) == pytest.approx(value, rel=1e-6), name
    assert fit.statistics["agreed"] == 2


def test_forced_closed_form_comes_near_and_starts_the_fit(smooth_forced: rtac.Recording) -> None:
    model = rtac.RTAC.from_rig(smooth_forced).without("cart_coulomb")
    found = est.least_squares(model, smooth_forced, cutoff=12.0)
    assert found.estimates["torque_constant"].pooled == pytest.approx(0.0804, rel=0.02)


@pytest.fixture(scope="module")
def noisy() -> rtac.Recording:
    plans = virtual_rig.standard_plans(seed=11, sample_time=0.005, duration=6.0, free=2, forced=4, rest=1)
    return virtual_rig.record(virtual_rig.Rig(), plans, seed=12)


def test_noisy_estimates_agree_with_the_truth_within_their_deviations(noisy: rtac.Recording) -> None:
    rig = virtual_rig.Rig()
    fit = est.output_error(rtac.RTAC.from_rig(noisy), noisy, progress=False)
    truth = {
        "spring_stiffness": rig.spring_stiffness, "cart_viscous.coefficient": rig.cart_viscous,
        "cart_coulomb.level": rig.cart_coulomb, "eccentric_moment": rig.eccentric_moment,
        "torque_constant": rig.torque_constant, "arm_viscous.positive": rig.arm_viscous_positive,
        "arm_viscous.negative": rig.arm_viscous_negative,
    }  # fmt: skip
    deviations = [(fit.parameters[n].value - v) / fit.parameters[n].std for n, v in truth.items()]
    assert np.max(np.abs(deviations)) < 4.0, dict(zip(truth, deviations, strict=True))
    assert np.sqrt(np.mean(np.square(deviations))) > 0.2  # deviations that never differ from zero are too wide
    assert fit.residual_std["cart_position"] == pytest.approx(2e-5, rel=0.1)
    assert fit.residual_std["arm_velocity"] == pytest.approx(0.05, rel=0.1)
    assert fit.parameters["total_mass"].std == 0.0
    closed = est.least_squares(rtac.RTAC.from_rig(noisy), noisy, reaction=True)
    for name, share in {"spring_stiffness": 0.01, "torque_constant": 0.01, "eccentric_moment": 0.1}.items():
        assert closed.estimates[name].pooled == pytest.approx(truth[name], rel=share), name

    train = est.compare(fit, noisy).models[0]
    assert train.errors["cart_position"].rms_over_noise == pytest.approx(1.0, abs=0.15)
    assert train.errors["arm_velocity"].fit_percent > 95.0


def test_a_rig_without_known_constants_is_refused_with_the_free_combination(noisy: rtac.Recording) -> None:
    unknown = rtac.Recording(noisy.experiments)
    with pytest.raises(est.NotIdentifiableError, match=r"free: .*total_mass.*scaled together.*Give a known constant"):
        est.output_error(rtac.RTAC.from_rig(unknown), unknown, progress=False, starts=1)


def test_a_model_that_diverges_is_refused(noisy: rtac.Recording) -> None:
    model = rtac.RTAC.from_rig(noisy) + rtac.effects.CubicSpring(-1e9)
    with pytest.raises(est.DivergedError, match="diverges at the start values"):
        est.output_error(model, noisy, progress=False, from_model=True)


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


# -- parts ---------------------------------------------------------------------------------------------------------------


def test_transform_is_invertible_and_keeps_bounds() -> None:
    infinity = np.inf
    lower = np.array([-infinity, 0.0, 0.0, -infinity, 2.0])
    upper = np.array([infinity, infinity, 1.0, 3.0, infinity])
    scale = np.array([5.0, 0.1, 1.0, 2.0, 1e-6])
    value = np.array([-7.0, 0.03, 0.3, -4.0, 2.0 + 3e-6])
    z = to_unconstrained(value, lower, upper, scale)
    np.testing.assert_allclose(to_physical(*map(jnp.asarray, (z, lower, upper, scale))), value, rtol=1e-12)
    for extreme in (-50.0, 50.0):
        moved = np.asarray(to_physical(jnp.full(5, extreme), *map(jnp.asarray, (lower, upper, scale))))
        assert np.all(moved >= lower)
        assert np.all(moved <= upper)


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


def test_kalman_filter_agrees_with_one_for_linear_systems() -> None:
    """A locked arm and no dry friction make a linear oscillator, for which the textbook filter is written out here."""
    random = np.random.default_rng(3)
    dt, count, density, sensor = 0.01, 300, 1e-4, 2e-5
    force = random.normal(size=count) * 0.1
    a = np.array([[0.0, 1.0], [-STIFFNESS / MASS, -VISCOUS / MASS]])
    block = expm(np.block([[a, np.array([[0.0], [1 / MASS]])], [np.zeros((1, 3))]]) * dt)
    f, g = block[:2, :2], block[:2, 2]
    x, measured = np.array([0.003, 0.0]), []
    push = np.array([0.0, 1 / MASS])
    for k in range(count):
        measured.append(x[0] + sensor * random.normal())
        x = f @ x + g * force[k] + push * np.sqrt(density * dt) * random.normal()
    experiment = rtac.Experiment.of(
        "a", kind="forced", sample_time=dt, disturbance_force=force, cart_position=np.array(measured), arm="locked"
    )
    model = rtac.RTAC.from_rig(rtac.Recording((experiment,), rig={})).without("cart_coulomb")
    space = space_of(model, [experiment], free=[], start={"a": np.array([0.003, 0.0, 0.0, 0.0])})
    found = filtered(
        model, Data.of([experiment]), space, space.physical(space.unconstrained(start=False)),
        sensor_variance=jnp.full((3, 1), sensor**2), process=(jnp.asarray(density), jnp.asarray(0.0)),
        start_variance=jnp.asarray([[1e-8], [1e-6], [0.0], [0.0]]), substeps=8,
    )  # fmt: skip

    state, spread, likelihood = np.array([0.003, 0.0]), np.diag([1e-8, 1e-6]), 0.0
    half = 0.5 * dt * density * np.outer(push, push)
    for k in range(count):
        variance = spread[0, 0] + sensor**2
        error = measured[k] - state[0]
        gain = spread[:, 0] / variance
        assert float(found.innovations[k, 0, 0]) == pytest.approx(error / np.sqrt(variance), abs=1e-5)
        np.testing.assert_allclose(np.asarray(found.gain[k, :2, 0, 0]), gain, rtol=1e-5)
        likelihood -= 0.5 * (error**2 / variance + np.log(variance))
        state = f @ (state + gain * error) + g * force[k]
        spread = f @ (spread - np.outer(gain, spread[0]) + half) @ f.T + half
    assert float(found.log_likelihood[0]) == pytest.approx(likelihood, rel=1e-6)


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
        from estimators._levenberg_marquardt import plain_residual

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


def test_information_names_what_is_free_and_matches_least_squares() -> None:
    random = np.random.default_rng(1)
    matrix = random.normal(size=(200, 2))
    known = information_of(matrix, ("a", "b"), np.array([1.0, 1.0]))
    np.testing.assert_allclose(known.covariance, np.linalg.inv(matrix.T @ matrix), rtol=1e-10)
    assert known.undetermined() == []
    together = information_of(matrix[:, :1] @ np.array([[1.0, -1.0]]), ("a", "b"), np.array([1.0, 1.0]))
    assert together.undetermined() == ["a, b may be scaled together"]
    silent = information_of(matrix * np.array([1.0, 0.0]), ("a", "b"), np.array([1.0, 1.0]))
    assert silent.undetermined() == ["b has no effect on what was measured"]
    with pytest.raises(est.NotIdentifiableError, match="b has no effect"):
        silent.require_determined()


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


def test_residual_statistics_of_a_trace() -> None:
    from estimators._compare import Trace

    random = np.random.default_rng(2)
    time = 0.01 * np.arange(2000)
    clean = np.sin(time)
    white = Trace("a", "cart_position", time, clean + 0.1 * random.normal(size=2000), clean, clean, time >= 0, 0.1)
    assert white.rms == pytest.approx(0.1, rel=0.1)
    assert white.fit_percent == pytest.approx(100 * (1 - white.rms / np.std(white.measured)), rel=1e-9)
    assert white.whiteness_p > 0.01
    assert np.mean(np.abs(white.autocorrelation()[0][1:]) < white.autocorrelation()[1]) > 0.9
    coloured = control.forced_response(control.tf([1], [0.05, 1]), time, random.normal(size=2000)).outputs
    stained = Trace("a", "cart_position", time, clean + coloured, clean, clean, time >= 0, 0.1)
    assert stained.whiteness_p < 1e-6
