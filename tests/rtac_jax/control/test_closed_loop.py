"""Controllers in the loop with the nonlinear rig, against another integrator, and for thousands of plants."""

import math
from itertools import pairwise

import control as ct
import numpy as np
import pytest
from own_controller import KM, KV, ME, SMOOTH, VISCOUS, J, K, M, own_design
from scipy.integrate import solve_ivp

import estimators as est
from estimators.controller.plant_sampling import plants_inside
from estimators.plots.control import plot_batch, plot_closed_loop, plot_margins, plot_synthesis
from rtac_jax import RTAC
from rtac_jax.control import (
    Actuation,
    ClosedLoop,
    Units,
    closed_loop,
    discretise,
    margins,
    mixed_sensitivity,
    nominal_plant,
    paper_nominal,
    paper_weights,
    reduce_controller,
)

# Standard deviation over mean of Table 1; that of k is contained in that of (M+m)/k.
SCATTER = {
    "total_mass": 0.0064,
    "eccentric_moment": 0.155,
    "torque_constant": 0.062,
    "cart_viscous.coefficient": 0.0968,
    "cart_coulomb.level": 0.1474,
    "arm_viscous.positive": 0.34,
    "arm_viscous.negative": 0.33,
}


@pytest.fixture(scope="module")
def design() -> tuple:
    return own_design()


def reference(
    controller: ct.StateSpace, acting: Actuation, start: tuple[float, float], time: np.ndarray, *, sampled: bool
) -> np.ndarray:
    """(N, 2) cart position and arm angle by DOP853 from equations (1) and (2) with Fig. 3, in plain NumPy."""
    a, b, c, d = (np.array(x) for x in (controller.A, controller.B[:, 0], controller.C[0], controller.D[0, 0]))
    position, torque = math.sqrt(M / J), M / (K * J)

    def command(x: np.ndarray, own: np.ndarray) -> float:
        cosine = math.cos(x[2])
        if abs(cosine) <= acting.dead_band:
            return 0.0
        push = -(c @ own + d * position * x[0]) / torque / cosine
        push = min(max(push, -acting.controller_limit), acting.controller_limit)
        return min(max(push - acting.arm_stiffness * x[2], -acting.motor_limit), acting.motor_limit)

    def moves(x: np.ndarray, push: float) -> list[float]:
        on_cart = -K * x[0] - VISCOUS * x[1] + ME * x[3] ** 2 * math.sin(x[2])
        on_arm, exchange = push - KV * x[3], ME * math.cos(x[2])
        determinant = M * J - exchange**2
        return [
            x[1],
            (J * on_cart - exchange * on_arm) / determinant,
            x[3],
            (M * on_arm - exchange * on_cart) / determinant,
        ]

    x, own, shown = np.array([start[0], 0.0, start[1], 0.0]), np.zeros(len(a)), []
    for begin, end in pairwise(time):
        shown.append(x[[0, 2]])
        if sampled:
            push = command(x, own)
            own = a @ own + b * position * x[0]
            solved = solve_ivp(lambda t, y, u=push: moves(y, u), (begin, end), x, "DOP853", rtol=1e-10, atol=1e-13)
            x = solved.y[:, -1]
        else:
            solved = solve_ivp(
                lambda t, y: [*moves(y[:4], command(y[:4], y[4:])), *(a @ y[4:] + b * position * y[0])],
                (begin, end), np.concatenate([x, own]), "DOP853", rtol=1e-9, atol=1e-12,
            )  # fmt: skip
            x, own = solved.y[:4, -1], solved.y[4:, -1]
    return np.array([*shown, x[[0, 2]]])


ACTINGS = [
    Actuation(),
    Actuation(controller_limit=0.006, arm_stiffness=1e-3),
    Actuation(motor_limit=0.004, dead_band=0.6),
]


@pytest.mark.parametrize("acting", ACTINGS)
def test_sampled_loop(design, acting):
    _, _, plant, _, found = design
    controller = discretise(reduce_controller(found).controller, plant, 0.01)
    time = 0.01 * np.arange(201)
    expected = reference(controller, acting, (0.006, 0.4), time, sampled=True)
    result = closed_loop(
        SMOOTH,
        controller,
        actuation=acting,
        displacement=0.006,
        arm_angle=0.4,
        duration=2.0,
        sample_time=0.01,
        substeps=8,
    )
    np.testing.assert_allclose(result.cart_position[:, 0], expected[:, 0], atol=1e-7 * 0.006)
    np.testing.assert_allclose(result.arm_angle[:, 0], expected[:, 1], atol=1e-6)
    assert result.time[-1] == pytest.approx(2.0)


@pytest.mark.parametrize("acting", ACTINGS[:2])
def test_continuous_loop(design, acting):
    _, _, _, _, found = design
    controller, time = reduce_controller(found).controller, 0.01 * np.arange(151)
    expected = reference(controller, acting, (0.006, 0.4), time, sampled=False)
    result = closed_loop(
        SMOOTH, controller, actuation=acting, displacement=0.006, arm_angle=0.4, duration=1.5, sample_time=0.01
    )
    np.testing.assert_allclose(result.cart_position[:, 0], expected[:, 0], atol=2e-5 * 0.006)
    np.testing.assert_allclose(result.arm_angle[:, 0], expected[:, 1], atol=5e-4)
    # The sampled controller is another one: so the test above can tell them apart.
    sampled = closed_loop(
        SMOOTH, discretise(controller, nominal_plant(SMOOTH), 0.01), actuation=acting, displacement=0.006, arm_angle=0.4,
        duration=1.5, sample_time=0.01,
    )  # fmt: skip
    assert np.max(np.abs(sampled.arm_angle[:, 0] - expected[:, 1])) > 5e-3


def test_batch_is_what_single_plants_are(design):
    units, acting, plant, _, found = design
    controller = discretise(reduce_controller(found).controller, plant, 0.005)
    masses, starts = np.array([1.1, 1.23, 1.4]), np.array([0.01, 0.015, -0.02])
    given = {"units": units, "actuation": acting, "duration": 1.0, "substeps": 2}
    together = closed_loop(RTAC.paper().with_values({"total_mass": masses}), controller, displacement=starts, **given)
    for column, (mass, start) in enumerate(zip(masses, starts, strict=True)):
        alone = closed_loop(RTAC.paper().with_values({"total_mass": mass}), controller, displacement=start, **given)
        np.testing.assert_allclose(together.cart_position[:, column], alone.cart_position[:, 0], atol=1e-14)
        np.testing.assert_allclose(together.torque[:, column], alone.torque[:, 0], atol=1e-12)


def test_drive_with_its_own_torque_constant(design):
    units, acting, plant, _, found = design
    controller = discretise(reduce_controller(found).controller, plant, 0.005)
    weak = RTAC.paper().with_values({"torque_constant": 0.5 * KM})
    given = {"units": units, "actuation": acting, "duration": 1.0}
    as_known = closed_loop(weak, controller, **given)
    believed = closed_loop(weak, controller, torque_constant=KM, **given)
    assert believed.arm_swing[0] < 0.8 * as_known.arm_swing[0]


def test_open_loop_takes_46_seconds():
    assert closed_loop(RTAC.paper(), None).settling_time()[0] == pytest.approx(4.6, abs=0.05)


def test_printed_problem_on_the_plant_of_table_1c():
    """The optimal controller for the printed P_0 winds up an arm that nothing pulls back; that is all there is to it."""
    found = mixed_sensitivity(paper_nominal(), paper_weights())
    result = closed_loop(RTAC.paper(), found.controller)
    assert result.wound_up[0]
    small = closed_loop(RTAC.paper(), found.controller, displacement=0.003)
    free = closed_loop(RTAC.paper(), None, displacement=0.003)
    assert small.settling_time()[0] < free.settling_time()[0]


@pytest.mark.parametrize(("relax", "settles"), [(1.0, 2.15), (1.15, 2.73)])
def test_fig_8_from_the_printed_problem(relax, settles):
    """With the electric spring and the limit on the swing that our own design gets, against another integrator too."""
    found = mixed_sensitivity(paper_nominal(), paper_weights(), relax=relax)
    acting = Actuation.proposed(RTAC.paper())
    result = closed_loop(RTAC.paper(), found.controller, actuation=acting)
    assert result.settling_time()[0] == pytest.approx(settles, abs=0.05)
    assert not result.wound_up[0]
    assert result.peak_torque[0] < 0.1
    # The other integrator has no dry friction.
    controller, time = discretise(found.controller, paper_nominal(), 0.01), 0.01 * np.arange(301)
    expected = reference(controller, acting, (0.015, 0.0), time, sampled=True)
    smooth = closed_loop(
        SMOOTH, controller, actuation=acting, displacement=0.015, duration=3.0, sample_time=0.01, substeps=8
    )
    np.testing.assert_allclose(smooth.cart_position[:, 0], expected[:, 0], atol=1e-6 * 0.015)
    np.testing.assert_allclose(smooth.arm_angle[:, 0], expected[:, 1], atol=1e-5)


@pytest.mark.slow
def test_the_printed_problem_is_less_robust_than_our_own_design(design):
    """Of plants whose parameters are up to 15 % off, nine in ten settle in time with the optimal controller of the printed problem.

    Of the one that is a little less than optimal, which settles later, three in four; of our own design 98 to 99 in a hundred.
    """
    units, acting, plant, _, own = design
    batch, shares = drawn("15 %", 1000), {}
    printed = {
        name: mixed_sensitivity(paper_nominal(), paper_weights(), relax=relax)
        for name, relax in (("optimal", 1.0), ("relaxed", 1.15))
    }
    for name, made in (printed | {"own": own}).items():
        controller = discretise(made.controller, plant, 0.005)
        result = closed_loop(batch, controller, units=units, actuation=acting, torque_constant=KM)
        shares[name] = np.mean(result.holds(within=3.0))
    assert 0.87 < shares["optimal"] < 0.95
    assert 0.70 < shares["relaxed"] < 0.84
    assert shares["own"] > 0.975


def saturated(result: ClosedLoop, acting: Actuation) -> np.ndarray:
    """Fraction of the first three seconds in which each plant's controller asks for more than it may."""
    within = result.time <= 3.0
    own = result.torque + acting.arm_stiffness * result.arm_angle
    return np.mean(np.abs(own[within]) >= acting.controller_limit * (1 - 1e-9), axis=0)


def test_own_design_settles_in_three_seconds(design):
    units, acting, plant, _, found = design
    controller = discretise(reduce_controller(found).controller, plant, 0.005)
    for chosen in (found.controller, controller):
        result = closed_loop(RTAC.paper(), chosen, units=units, actuation=acting)
        assert result.settling_time()[0] <= 3.0
        assert saturated(result, acting)[0] < 0.4
        assert not result.wound_up[0]


def drawn(kind: str, count: int) -> RTAC:
    model, random = RTAC.paper(), np.random.default_rng(11)
    if kind == "15 %":
        spread = {name: 1 + 0.15 * random.uniform(-1, 1, count) for name in model.parameters}
    else:
        spread = {name: np.maximum(1 + std * random.standard_normal(count), 0.05) for name, std in SCATTER.items()}
    return model.with_values({name: float(model[name]) * factor for name, factor in spread.items()})


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["15 %", "Table 1"])
def test_own_design_holds_for_2000_plants(design, kind):
    units, acting, plant, _, found = design
    controller = discretise(reduce_controller(found).controller, plant, 0.005)
    batch = drawn(kind, 2000)
    result = closed_loop(batch, controller, units=units, actuation=acting, torque_constant=KM)
    assert np.mean(result.holds(within=3.0)) >= 0.99
    assert np.quantile(saturated(result, acting), 0.99) < 0.5
    free = closed_loop(batch, None)
    assert np.mean(free.settling_time() <= 3.0) < 0.01


@pytest.mark.slow
def test_plants_inside_an_envelope_are_inside():
    """Against equations (1) and (2) at small motions, in plain NumPy, and all-pass perturbations of the envelope itself."""
    model, acting = RTAC.paper(), Actuation.proposed(RTAC.paper())
    omega = np.geomspace(6.0, 40.0, 80)
    s = 1j * omega

    def response(mass, inertia, moment, spring, constant, viscous, ahead, back):
        cart = mass * s**2 + viscous * s + spring
        # The drive believes the model's torque constant, also where it makes the electric spring.
        arm = inertia * s**2 + 0.5 * (ahead + back) * s + acting.arm_stiffness * constant / KM
        return -moment * s**2 * constant / (cart * arm - (moment * s**2) ** 2)

    # Dry friction shows as damping: the conditions are those of a cart that is damped several times as much.
    damped = [response(M, J, ME * f, K, KM, VISCOUS * g, KV, KV) for f in (0.8, 1.0, 1.2) for g in (4.0, 8.0)]
    covered = est.envelope(np.array(damped), omega=omega, progress=False)
    found = plants_inside(covered, model, acting, off=0.15, count=300)
    assert found is not None
    names = ("total_mass", "arm_inertia", "eccentric_moment", "spring_stiffness", "torque_constant", "cart_viscous.coefficient",
             "arm_viscous.positive", "arm_viscous.negative")  # fmt: skip
    assert set(found.parameters) == set(names)
    drawn = np.array([np.asarray(found[name]) for name in names])
    plants = np.array([response(*row) for row in drawn.T])
    gaps = np.abs(plants / covered.nominal_response() - 1) / covered.weight_magnitude()
    assert len(gaps) == 300
    assert np.max(gaps) <= 1 + 1e-6
    assert np.max(gaps) > 0.9, "up to the boundary"
    ratio = drawn / np.array([[float(model[name])] for name in names])
    assert np.all(np.abs(np.log(np.delete(ratio, 5, axis=0))) <= np.log(1.15) + 1e-12)
    assert 2 < np.median(ratio[5]) < 20
    nowhere = est.envelope(100 * np.array(damped), omega=omega, progress=False)
    assert plants_inside(nowhere, model, acting, off=0.15, count=10) is None


def test_noise_and_disturbance(design):
    units, acting, plant, _, found = design
    controller = discretise(reduce_controller(found).controller, plant, 0.005)
    noisy = {"position_noise": 5e-5, "angle_noise": 1e-3}
    given = {"units": units, "actuation": acting}
    one, same, other = (closed_loop(RTAC.paper(), controller, seed=s, **noisy, **given) for s in (3, 3, 4))
    np.testing.assert_array_equal(one.torque, same.torque)
    assert np.any(one.torque != other.torque)
    assert one.holds()[0]
    # A push at the resonance.
    push = 0.05 * np.sin(10.4 * 0.005 * np.arange(4000))
    closed = closed_loop(RTAC.paper(), controller, displacement=0.0, force=push, **given, **noisy)
    free = closed_loop(RTAC.paper(), None, displacement=0.0, force=push)
    late = slice(3000, None)
    assert np.std(closed.cart_position[late]) < 0.5 * np.std(free.cart_position[late])
    assert not closed.wound_up[0]


def test_metrics():
    time = np.linspace(0, 2, 201)
    falling = np.where(time < 1.0, 1.0, 0.05)
    late = np.where((time > 1.5) & (time < 1.6), 0.2, falling)
    never = np.ones(201)
    broken = np.where(time > 1.2, np.nan, falling)
    position = np.stack([falling, late, never, broken], axis=1)
    angle = np.stack([np.sin(time), 2 * np.sin(3 * time), 0 * time, 0 * time], axis=1)
    torque = np.stack([0.1 * np.sign(time - 1), 0.05 + 0 * time, 0 * time, 0 * time], axis=1)
    found = ClosedLoop(time, position, angle, 0 * angle, torque, 0.1)
    np.testing.assert_allclose(found.settling_time(), [1.0, 1.6, np.inf, np.inf], atol=0.011)
    np.testing.assert_array_equal(found.wound_up, [False, True, False, False])
    np.testing.assert_array_equal(found.holds(within=1.7), [True, False, False, False])
    np.testing.assert_allclose(found.effort, [0.1 * math.sqrt(200 / 201), 0.05, 0, 0])
    np.testing.assert_allclose(found.saturated, [200 / 201, 0, 0, 0])


def test_pictures_state_what_they_show(design):
    units, acting, plant, weights, found = design
    given = {"units": units, "actuation": acting, "duration": 5.0}
    controller = discretise(found.controller, plant, 0.005)
    free, closed = closed_loop(RTAC.paper(), None, duration=5.0), closed_loop(RTAC.paper(), controller, **given)
    both = closed_loop(RTAC.paper(), controller, displacement=np.array([0.01, 0.015]), **given)
    stability = margins(plant, controller=found.controller, weights=weights).worst_stability[0]
    for figure, words in (
        (plot_closed_loop(free, {"closed loop": closed}), f"closed loop {closed.settling_time()[0]:.2f} s"),
        (plot_synthesis(found), f"{found.robustness:.2f}"),
        (plot_margins(margins(plant, found.controller, weights)), "Stable for the whole envelope"),
        (plot_batch(both, free=free), "100.0 % of 2 plants"),
    ):
        assert words in figure.get_suptitle()
        assert all(axis.get_xlabel() or axis.get_ylabel() for axis in figure.axes)
    assert stability < 1


ONE = ct.tf([1.0], [1.0])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: closed_loop(SMOOTH, ONE, duration=np.inf), "duration is inf"),
        (lambda: closed_loop(SMOOTH, ONE, position_noise=-1.0), "position_noise is -1"),
        (lambda: closed_loop(SMOOTH, ONE, displacement=np.nan), "must be finite"),
        (lambda: closed_loop(SMOOTH, ONE, force=np.array([0.0, np.inf])), "must be finite"),
        (lambda: closed_loop(SMOOTH, ct.ss([[np.nan]], [[1.0]], [[1.0]], [[0.0]])), "not finite"),
        (lambda: closed_loop(SMOOTH, ct.ss([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.1)), "sample time of 0.1 s"),
        (lambda: closed_loop(SMOOTH, ct.ss(np.eye(2), np.eye(2), np.eye(2), 0)), "one input"),
        (
            lambda: closed_loop(SMOOTH.with_values({"total_mass": np.full(3, M)}), ONE, units=Units.si(), displacement=np.ones(2)),
            "one value of each parameter",
        ),
        (lambda: closed_loop(SMOOTH.with_values({"total_mass": np.full(3, M)}), ONE), "give the units"),
        (lambda: Actuation(controller_limit=0.0), "controller_limit is 0.0, but must be positive"),
        (lambda: Actuation(arm_stiffness=-1.0), "arm_stiffness is -1.0"),
        (lambda: Actuation.proposed(SMOOTH, arm_swing=2.0), "between 0 and pi/2"),
    ],
)  # fmt: skip
def test_bad_input(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize("duration", [7.9, 7.95, 8.0, 8.05, 8.1, 9.0, 12.0, 13.0, 16.0])
def test_a_response_that_ends_as_it_passes_through_zero_has_not_settled(duration):
    """A swing in closed form: a record of 8 s ended near zero, and was said to have settled just before."""
    whole, time = (np.arange(round(end / 1e-3) + 1) * 1e-3 for end in (40.0, duration))
    swing = np.exp(-0.19 * whole) * np.cos(10.38 * whole)
    true = whole[np.flatnonzero(np.abs(swing) > 0.1)[-1] + 1]
    found = ClosedLoop(time, swing[: len(time), None], *(np.zeros((len(time), 1)),) * 3, 0.1).settling_time()[0]
    assert found == pytest.approx(true, abs=2e-3) if duration > true + 0.4 else found == np.inf
