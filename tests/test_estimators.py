"""Closed form, output error, noise, filter and covariance against truths that do not come from the package's model."""

import dataclasses
import functools
import re
import subprocess
import sys

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
DRY, INERTIA, MOMENT, TORQUE, ONWARD, BACK = 0.024, 9.5e-5, 1.06e-3, 0.0804, 1.39e-4, 1.49e-4  # and Table 1
TRUTH = {
    "spring_stiffness": STIFFNESS, "cart_viscous.coefficient": VISCOUS, "cart_coulomb.level": DRY,
    "eccentric_moment": MOMENT, "torque_constant": TORQUE, "arm_viscous.positive": ONWARD, "arm_viscous.negative": BACK,
}  # fmt: skip
SYMMETRIC = 1.4e-4  # viscous friction of an arm that turns alike both ways
SMOOTH_TRUTH = {n: SYMMETRIC if n.startswith("arm") else v for n, v in TRUTH.items() if n != "cart_coulomb.level"}


def exact_decay(position: float, time: np.ndarray, dry: float = 0.0) -> np.ndarray:
    """A damped oscillator let go from rest, in closed form: from turn to turn it swings about +-d/k, until it sticks."""
    rate = VISCOUS / (2 * MASS)
    damped = np.sqrt(STIFFNESS / MASS - rate**2)
    found, begin = np.full_like(time, position), 0.0
    while abs(position) > dry / STIFFNESS and begin <= time[-1]:
        middle, after = np.copysign(dry / STIFFNESS, position), time - begin
        swing = np.exp(-rate * after) * (np.cos(damped * after) + rate / damped * np.sin(damped * after))
        found = np.where(after >= 0, middle + (position - middle) * swing, found)
        position = middle - (position - middle) * np.exp(-rate * np.pi / damped)
        begin += np.pi / damped
    return np.where(time >= begin, position, found)


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
    mass, inertia, moment, torque, friction = MASS, INERTIA, MOMENT, TORQUE, SYMMETRIC
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
    assert set(fit.model.free) == SMOOTH_TRUTH.keys()
    for name, value in SMOOTH_TRUTH.items():
        assert float(fit.model[name]) == pytest.approx(value, rel=1e-6), name
    assert fit.statistics["agreed"] == 2


def test_forced_closed_form_comes_near_and_starts_the_fit(smooth_forced: rtac.Recording) -> None:
    model = rtac.RTAC.from_rig(smooth_forced).without("cart_coulomb")
    found = est.least_squares(model, smooth_forced, cutoff=12.0)
    assert found.estimates["torque_constant"].pooled == pytest.approx(0.0804, rel=0.02)
    # A current that jumps every 10 ms bends the arm's motion between samples, which the trapezoidal rule misses.
    weak = est.least_squares(model, smooth_forced, weak=True).estimates
    assert weak.keys() == SMOOTH_TRUTH.keys()
    for name, value in SMOOTH_TRUTH.items():
        assert weak[name].pooled == pytest.approx(value, rel=5e-4), name


FINEST = 6.25e-5  # s


def swung(start: tuple[float, ...], phases: np.ndarray, time: np.ndarray, dry: float) -> np.ndarray:
    """States of the driven rig by DOP853, from one turn of cart or arm to the next: in between, friction is smooth."""

    def slope(t: float, x: np.ndarray, cart: float, arm: float) -> np.ndarray:
        _, v, angle, w = x
        exchange = MOMENT * np.cos(angle)
        on_cart = -STIFFNESS * x[0] - VISCOUS * v - dry * cart + MOMENT * w * w * np.sin(angle)
        on_arm = TORQUE * gentle_current(t, phases) - (ONWARD if arm > 0 else BACK) * w
        a = INERTIA * on_cart - exchange * on_arm
        b = MASS * on_arm - exchange * on_cart
        determinant = MASS * INERTIA - exchange**2
        return np.array([v, a / determinant, w, b / determinant])

    states, x, t = np.full((len(time), 4), np.nan), np.array(start), 0.0
    begins = slope(t, x, 0.0, 1.0)
    cart, arm = np.sign(begins[1]), np.sign(begins[3])
    while t < time[-1]:

        def cart_turns(_: float, x: np.ndarray, *signs: float) -> float:
            return x[1]

        def arm_turns(_: float, x: np.ndarray, *signs: float) -> float:
            return x[3]

        cart_turns.terminal = arm_turns.terminal = True
        cart_turns.direction, arm_turns.direction = -cart, -arm
        # Short steps for the sake of the interpolation between them, which is differenced twice.
        solved = solve_ivp(
            slope, (t, time[-1]), x, "DOP853", args=(cart, arm), rtol=1e-12, atol=1e-14, max_step=2e-3,
            events=(cart_turns, arm_turns), dense_output=True,
        )  # fmt: skip
        part = (time >= t) & (time <= solved.t[-1])
        if part.any():
            states[part] = solved.sol(time[part]).T
        t, x = solved.t[-1], solved.y[:, -1]
        if len(solved.t_events[0]):
            cart, x[1] = -cart, 0.0
            assert cart * slope(t, x, cart, arm)[1] > 0, "the cart should not stick"
        elif len(solved.t_events[1]):
            arm, x[3] = -arm, 0.0
    return states


def gentle_current(time: np.ndarray | float, phases: np.ndarray) -> np.ndarray | float:
    """Near the cart's resonance and weak, so that the arm's swing makes no harmonics to speak of.

    The weak form takes the velocity by which the cart turns the arm from within eight times the cart's frequency: at 4 Hz
    and twice the current that costs the arm's parameters 1e-5, however fine the samples.
    """
    return sum(0.04 * np.sin(2 * np.pi * f * time + p) for f, p in zip((1.3, 1.5, 1.7, 1.9), phases, strict=True))


@functools.cache
def gentle_states(dry: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Phases of the current and states of three runs, on the finest grid."""
    time = FINEST * np.arange(40000)
    starts = ((0.012, 0.0, -0.7, 0.0), (0.01, 0.0, 1.2, 0.0), (-0.011, 0.0, 0.2, 0.0))
    phases = [np.random.default_rng(i).uniform(0, 2 * np.pi, 4) for i in range(len(starts))]
    return [(p, swung(x, p, time, dry)) for p, x in zip(phases, starts, strict=True)]


def gentle(every: int, dry: float) -> rtac.Recording:
    """Exact decays with the arm locked, and forced runs, every so many of the finest samples; no noise."""
    dt = every * FINEST
    time = dt * np.arange(-(-40000 // every))
    decays = [
        rtac.Experiment.of(
            f"free_{i}", kind="free", sample_time=dt, arm="locked", initial_arm_angle=0.0,
            cart_position=exact_decay(q, time, dry), noise_std={"cart_position": 1e-9},
        )
        for i, q in enumerate((0.015, 0.012, 0.009))
    ]  # fmt: skip
    forced = [
        rtac.Experiment.of(
            f"forced_{i}", kind="forced", sample_time=dt, initial_arm_angle=states[0, 2], intersample="bl",
            current=np.asarray(gentle_current(time, phases)), cart_position=states[::every, 0],
            arm_velocity=states[::every, 3], arm_angle=states[::every, 2],
            noise_std={"cart_position": 1e-9, "arm_velocity": 1e-5, "arm_angle": 1e-7},
        )
        for i, (phases, states) in enumerate(gentle_states(dry))
    ]  # fmt: skip
    return rtac.Recording((*decays, *forced), rig={"total_mass": MASS, "arm_inertia": INERTIA})


@functools.cache
def differenced(every: int) -> est.ClosedForm:
    """The paper's way on runs with dry friction, with the arm's reaction, and away from turns, where sgn q' is no constant.

    The sign's jump rings through the filter for some periods of its cutoff, so a cutoff in proportion to the sampling rate
    keeps it within the stretches that are left out.
    """
    recording = gentle(every, DRY)
    model = rtac.RTAC.from_rig(recording)
    return est.least_squares(model, recording, reaction=True, near_zero=0.6, cutoff=0.2 / (every * FINEST))


def errors(found: est.ClosedForm) -> dict[str, float]:
    return {name: e.pooled / TRUTH[name] - 1 for name, e in found.estimates.items()}


def test_differenced_closed_form_without_noise_errs_by_the_square_of_the_step() -> None:
    """At 1e-6 all seven parameters, dry friction included, at steps of 1/16 ms; above, the differences are what is wrong."""
    found = {every: errors(differenced(every)) for every in (4, 2, 1)}
    for every, error in found.items():
        # A central second difference of a cosine is too small by (w dt)^2 / 12, and so is k/(M+m).
        assert error["spring_stiffness"] == pytest.approx(-STIFFNESS / MASS * (every * FINEST) ** 2 / 12, rel=0.1)
    for coarse, fine in ((4, 2), (2, 1)):
        assert 3.5 < found[coarse]["eccentric_moment"] / found[fine]["eccentric_moment"] < 4.5, found
    assert found[1].keys() == TRUTH.keys()
    assert max(map(abs, found[1].values())) < 1e-6, found[1]


def test_all_parameters_without_noise_output_error_closed_form_and_truth_agree() -> None:
    recording = gentle(128, DRY)
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False, tolerance=1e-10, starts=1)
    assert set(fit.model.free) == set(TRUTH)
    closed = differenced(1).estimates
    for name, value in TRUTH.items():
        assert float(fit.model[name]) == pytest.approx(value, rel=1e-6), name
        assert float(fit.model[name]) == pytest.approx(closed[name].pooled, rel=1e-6), name


def test_weak_closed_form_without_noise_gives_the_truth() -> None:
    """To 1e-6 at 2 ms already where friction is viscous, and with dry friction still so of the arm's parameters.

    Turns of the cart, where dry friction jumps, are looked for within four times its frequency; that shifts them by a little
    which no finer sampling mends, and moves friction between v and d.
    """
    smooth = gentle(32, 0.0)
    model = rtac.RTAC.from_rig(smooth)
    found = errors(est.least_squares(model.without("cart_coulomb"), smooth, weak=True))
    assert found.keys() == TRUTH.keys() - {"cart_coulomb.level"}
    assert max(map(abs, found.values())) < 1e-6, found
    found = errors(est.least_squares(model, gentle(32, DRY), weak=True))
    assert found.keys() == TRUTH.keys()
    coarse = {"spring_stiffness": 2e-5, "cart_viscous.coefficient": 2e-4, "cart_coulomb.level": 3e-4}
    assert all(abs(error) < coarse.get(name, 1e-6) for name, error in found.items()), found


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


def test_a_rig_without_known_constants_is_refused_with_the_free_combination(noisy: rtac.Recording) -> None:
    unknown = rtac.Recording(noisy.experiments)
    with pytest.raises(est.NotIdentifiableError, match=r"free: .*total_mass.*scaled together.*Give a known constant"):
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
    data = Data.of([experiment])
    # A third of the samples is followed and does not count.
    counts = (np.arange(count) % 3 > 0).astype(float)
    found, some = (
        filtered(
            model, dataclasses.replace(data, trusted=trusted), space, space.physical(space.unconstrained(start=False)),
            sensor_variance=jnp.full((3, 1), sensor**2), process=(jnp.asarray(density), jnp.asarray(0.0)),
            start_variance=jnp.asarray([[1e-8], [1e-6], [0.0], [0.0]]), substeps=8,
        )
        for trusted in (data.trusted, jnp.asarray(counts[:, None]))
    )  # fmt: skip

    state, spread, likelihood, counted = np.array([0.003, 0.0]), np.diag([1e-8, 1e-6]), 0.0, 0.0
    half = 0.5 * dt * density * np.outer(push, push)
    for k in range(count):
        variance = spread[0, 0] + sensor**2
        error = measured[k] - state[0]
        gain = spread[:, 0] / variance
        assert float(found.innovations[k, 0, 0]) == pytest.approx(error / np.sqrt(variance), abs=1e-5)
        np.testing.assert_allclose(np.asarray(found.gain[k, :2, 0, 0]), gain, rtol=1e-5)
        assert float(some.innovations[k, 0, 0]) == pytest.approx(counts[k] * error / np.sqrt(variance), abs=1e-5)
        np.testing.assert_allclose(np.asarray(some.gain[k, :2, 0, 0]), gain, rtol=1e-5)
        likelihood -= 0.5 * (error**2 / variance + np.log(variance))
        counted -= 0.5 * counts[k] * (error**2 / variance + np.log(variance))
        state = f @ (state + gain * error) + g * force[k]
        spread = f @ (spread - np.outer(gain, spread[0]) + half) @ f.T + half
    assert float(found.log_likelihood[0]) == pytest.approx(likelihood, rel=1e-6)
    assert float(some.log_likelihood[0]) == pytest.approx(counted, rel=1e-6)
    assert not np.any(np.asarray(some.whitener)[counts == 0])


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
