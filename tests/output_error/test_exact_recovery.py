"""Estimators on motions without noise, known in closed form or from another integrator: they have to give the truth."""

import functools

import numpy as np
import pytest
from exact_decay import BACK, DRY, INERTIA, MASS, MOMENT, ONWARD, STIFFNESS, TORQUE, TRUTH, VISCOUS, exact_decay
from scipy.integrate import solve_ivp

import estimators as est
import rtac_jax as rtac

SYMMETRIC = 1.4e-4  # viscous friction of an arm that turns alike both ways
SMOOTH_TRUTH = {n: SYMMETRIC if n.startswith("arm") else v for n, v in TRUTH.items() if n != "cart_coulomb.level"}


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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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
