"""Controllers of the mixed-sensitivity problem: the paper's, proposals, reduction, discretisation and margins."""

import dataclasses

import control as ct
import numpy as np
import pytest
from own_controller import OMEGA, SMOOTH, own_design, response

import estimators as est
from rtac_jax import RTAC
from rtac_jax.control import (
    InfeasibleError,
    Units,
    Weights,
    closed_gamma,
    closed_loop,
    discretise,
    margins,
    mixed_sensitivity,
    nominal_plant,
    paper_nominal,
    paper_weights,
    price,
    propose_weights,
    reduce_controller,
)


def rows(plant: np.ndarray, controller: np.ndarray, weights: Weights) -> np.ndarray:
    """The three rows of (9) over OMEGA, in plain NumPy."""
    s = 1 / (1 + plant * controller)
    return np.stack(
        [
            response(weights.effort) * controller * s,
            response(weights.uncertainty) * plant * controller * s,
            response(weights.performance) * s,
        ]
    )


def test_printed_weights():
    weights, s = paper_weights(), 1j * OMEGA
    desired = (s**2 + 20 * s + 10**2 + 12.9**2) / (s**2 + 5.4 * s + 2.7**2 + 12.9**2)
    uncertainty = 0.55 * (s / 2 + 1) * (s / 80 + 1) / ((s / 5 + 1) * (s / 1000 + 1))
    band_stop = 0.15 * (s**2 + 2.4 * s + 64) * (s**2 + 4.2 * s + 196) / ((s / 1.4 + 8) ** 2 * (s / 0.7 + 14) ** 2)
    np.testing.assert_allclose(response(weights.desired), desired, rtol=1e-9)
    np.testing.assert_allclose(response(weights.uncertainty), uncertainty, rtol=1e-9)
    np.testing.assert_allclose(response(weights.effort), band_stop, rtol=1e-9)
    np.testing.assert_allclose(response(weights.performance), 0.17 * desired, rtol=1e-9)
    np.testing.assert_allclose(response(weights.w1), band_stop / desired, rtol=1e-7)
    np.testing.assert_allclose(response(weights.w2), uncertainty / desired, rtol=1e-7)
    np.testing.assert_allclose(response(weights.w3), 0.17 * np.ones(len(s)), rtol=1e-7)
    # Common factors are cancelled: nothing has more states than it needs.
    assert [len(w.poles()) for w in (weights.effort, weights.uncertainty, weights.performance)] == [4, 2, 2]
    assert [len(w.poles()) for w in (weights.w1, weights.w2, weights.w3)] == [6, 4, 0]
    zeros, poles = (175.7, -32.7), ((2.7, 12.9), (4.1, 37.4))
    plant = 3.7e-3 * (s - zeros[0]) * (s - zeros[1]) * ((s + 14.5) ** 2 + 26.6**2)
    for real, imaginary in poles:
        plant = plant / ((s + real) ** 2 + imaginary**2)
    np.testing.assert_allclose(response(paper_nominal()), plant, rtol=1e-9)


def test_paper_problem():
    weights = paper_weights()
    found = mixed_sensitivity(paper_nominal(), weights, relax=1.0)
    norms = np.linalg.norm(rows(response(paper_nominal()), response(found.controller), weights), axis=0)
    np.testing.assert_allclose(found.gamma, np.max(norms), rtol=1e-3)
    np.testing.assert_allclose(found.gamma, closed_gamma(paper_nominal(), found.controller, weights), rtol=1e-6)
    assert np.all(ct.feedback(ct.ss(paper_nominal()) * found.controller, 1).poles().real < 0)
    assert found.robustness < 1
    assert np.max(np.abs(rows(response(paper_nominal()), response(found.controller), weights)[1])) < 1
    assert "every plant of the envelope is stable" in str(found)
    fast = dataclasses.replace(weights, performance=100 * weights.performance)
    bold = mixed_sensitivity(paper_nominal(), fast, limit=np.inf)
    assert bold.robustness > 1
    assert "the envelope is not covered" in str(bold)
    # As good as any controller can be.
    assert found.gamma < 1.002 * found.bound


def test_no_controller_reaches_029_with_the_printed_weights():
    """The target gamma <= 0.29 contradicts S + T = 1: at 12.9 rad/s |W| is 1.31 and |W_3 W_d| is 0.67."""
    s = 12.9j
    robust = abs(0.55 * (s / 2 + 1) * (s / 80 + 1) / ((s / 5 + 1) * (s / 1000 + 1)))
    fast = 0.17 * abs((s**2 + 20 * s + 10**2 + 12.9**2) / (s**2 + 5.4 * s + 2.7**2 + 12.9**2))
    x, y = np.meshgrid(np.linspace(-1, 2, 601), np.linspace(-1.5, 1.5, 601))
    least = np.min(np.hypot(fast * np.abs(x + 1j * y), robust * np.abs(1 - x - 1j * y)))
    assert 0.59 < least < 0.60
    with pytest.raises(InfeasibleError, match=r"below 0\.598 .* at 12\.9 rad/s .* exclude each other"):
        mixed_sensitivity(paper_nominal(), paper_weights(), limit=0.29)


def test_relaxed_controller_keeps_its_promise():
    found = mixed_sensitivity(paper_nominal(), paper_weights(), relax=1.3)
    assert found.optimum < found.gamma <= 1.3 * found.optimum * 1.001
    norms = np.linalg.norm(rows(response(paper_nominal()), response(found.controller), paper_weights()), axis=0)
    np.testing.assert_allclose(found.gamma, np.max(norms), rtol=2e-3)


@pytest.fixture(scope="module")
def design() -> tuple:
    return own_design()


def test_proposal(design):
    _, _, plant, weights, found = design
    poles = plant.poles()
    dominant = poles[np.argmax(np.abs(poles))]
    moved = weights.desired.zeros()
    np.testing.assert_allclose(np.abs(moved.imag), abs(dominant.imag), rtol=1e-6)
    assert np.all(moved.real < 2 * dominant.real)
    assert found.gamma < 1
    assert found.robustness < 1
    # Hardly any gain where an offset of the sensor would turn the arm, and the most near the resonance.
    gain = np.abs(response(found.controller))
    assert gain[0] < 0.01 * np.max(gain)
    assert 0.5 < OMEGA[np.argmax(gain)] / abs(dominant) < 2


def test_proposal_does_not_depend_on_units(design):
    units, actuation, _, _, found = design
    plant = nominal_plant(RTAC.paper(), units=Units.si(), actuation=actuation)
    weights = propose_weights(plant, ct.tf([0.8], [1]), actuation.controller_limit, displacement=0.015)
    other = mixed_sensitivity(plant, weights)
    assert other.gamma == pytest.approx(found.gamma, rel=2e-3)
    np.testing.assert_allclose(
        response(other.controller) * units.torque / units.position, response(found.controller),
        rtol=0.05, atol=1e-3 * np.max(np.abs(response(found.controller))),
    )  # fmt: skip


def test_wider_envelope_asks_for_less_damping():
    damped = []
    for width in (0.5, 1.0, 1.5, 3.0):
        _, _, _, weights, found = own_design(width)
        damped.append(-weights.desired.zeros()[0].real)
        assert found.gamma <= 1
    assert damped[0] >= damped[1] > damped[2] > damped[3]


def test_a_resonance_outside_the_measured_band_is_not_taken_for_the_one_to_damp():
    """Fitted models put sharp pairs of poles and zeros where nothing was measured."""
    spurious = ct.tf([1.0, 0.0, 2.0**2], [1.0, 0.002, 2.1**2])
    plant = ct.ss(LAG) * ct.ss(spurious)
    for band, expected in (((5.0, 40.0), 10.0), ((0.0, np.inf), 2.1)):
        weights = propose_weights(plant, 0.3 * ONE, 1.0, displacement=1.0, band=band)
        assert np.max(weights.desired.zeros().imag) == pytest.approx(expected, rel=0.01)


def test_reduction(design):
    _, _, plant, weights, found = design
    smaller = reduce_controller(found)
    assert smaller.controller.nstates < found.controller.nstates
    norm = np.max(np.linalg.norm(rows(response(plant), response(smaller.controller), weights), axis=0))
    assert smaller.gamma == pytest.approx(norm, rel=2e-3)
    assert smaller.gamma <= 1.02 * found.gamma
    assert np.all(ct.feedback(plant * smaller.controller, 1).poles().real < 0)
    assert reduce_controller(found, order=found.controller.nstates).controller is found.controller
    assert reduce_controller(found, order=3).controller.nstates == 3
    assert f"-> {smaller.controller.nstates}" in str(smaller)


@pytest.mark.parametrize("method", ["tustin", "foh", "zoh"])
def test_discretisation(design, method):
    _, _, plant, _, found = design
    sampled = discretise(found.controller, plant, 0.005, method=method)
    assert sampled.dt == 0.005
    low = OMEGA[(OMEGA > 5) & (OMEGA < 20)]
    np.testing.assert_allclose(
        np.asarray(sampled(np.exp(0.005j * low))) * np.exp(0.0025j * low if method == "zoh" else 0.0),
        np.asarray(found.controller(1j * low)), rtol=0.02,
    )  # fmt: skip
    held = ct.sample_system(plant, 0.005, method="zoh")
    assert np.all(np.abs(ct.feedback(held * sampled, 1).poles()) < 1)


def test_margins(design):
    _, _, plant, weights, found = design
    result = margins(plant, found.controller, weights)
    p, c = response(plant), response(found.controller)
    s = 1 / (1 + p * c)
    robust = np.abs(response(weights.uncertainty) * p * c * s)
    both = robust + np.abs(response(weights.performance) * s)
    assert result.worst_stability[0] == pytest.approx(np.max(robust), rel=1e-3)
    assert result.worst_performance[0] == pytest.approx(np.max(both), rel=1e-3)
    assert result.worst_performance[1] == pytest.approx(OMEGA[np.argmax(both)], rel=1e-2)
    assert np.min(result.disk) == pytest.approx(np.min(np.abs(1 + p * c)), rel=1e-3)
    assert f"{result.worst_stability[0]:.3f}" in str(result)


def test_margins_of_a_sampled_loop_are_those_of_its_difference_equations(design):
    """T by the amplitude that a sinusoidal reference leaves in the held plant, stepped sample by sample."""
    _, _, plant, weights, found = design
    step = 0.05
    law = discretise(reduce_controller(found).controller, plant, step)
    result = margins(plant, law, weights)
    worst, place = result.worst_stability
    held = ct.ss(ct.sample_system(plant, step, method="zoh"))
    x, own = np.zeros(held.nstates, dtype=complex), np.zeros(law.nstates, dtype=complex)
    z = np.exp(1j * place * step)
    for n in range(4000):
        y = (held.C @ x)[0]
        error = z**n - y
        u = (law.C @ own)[0] + law.D[0, 0] * error
        x, own = held.A @ x + held.B[:, 0] * u, law.A @ own + law.B[:, 0] * error
    weight = abs(complex(weights.uncertainty(1j * place)))
    assert worst == pytest.approx(weight * abs((held.C @ x)[0]), rel=1e-3)
    assert result.frequency[-1] < np.pi / step
    continuous = margins(plant, reduce_controller(found).controller, weights).worst_stability[0]
    assert worst > 1.01 * continuous  # the hold costs phase
    fast = margins(plant, discretise(reduce_controller(found).controller, plant, 1e-3), weights).worst_stability[0]
    assert fast == pytest.approx(continuous, rel=0.02)


def test_margin_is_where_stability_ends(design):
    """All-pass perturbations below the margin keep the loop stable, and one just above it does not."""
    _, _, plant, weights, found = design
    worst, place = margins(plant, found.controller, weights).worst_stability

    def stable(size: float, corner: float, sign: float) -> bool:
        perturbation = ct.ss(ct.tf([-sign * size, sign * size * corner], [1, corner]))
        disturbed = plant * (1 + ct.ss(weights.uncertainty) * perturbation)
        return bool(np.all(ct.feedback(disturbed * found.controller, 1).poles().real < 0))

    corners = place * np.geomspace(1e-3, 1e3, 121)
    assert all(stable(0.99 / worst, corner, sign) for corner in corners for sign in (1.0, -1.0))
    assert not all(stable(1.05 / worst, corner, sign) for corner in corners for sign in (1.0, -1.0))


def test_price_of_what_a_model_leaves_out(design):
    units, acting, plant, _, _ = design
    limit, displacement = acting.controller_limit * units.torque, 0.015 * units.position
    result = price(
        {"without": (plant, ct.tf([1.6], [1])), "with": (plant, ct.tf([0.5], [1]))}, limit, displacement=displacement
    )
    assert result.gamma["without"] > 1 > result.gamma["with"]
    assert result.damping["without"] < 0.7 * result.damping["with"]
    for name, width in (("without", 1.6), ("with", 0.5)):
        weights = result.syntheses[name].weights
        assert abs(weights.uncertainty(1j)) == pytest.approx(width)
        norm = np.max(
            np.linalg.norm(rows(response(plant), response(result.syntheses[name].controller), weights), axis=0)
        )
        assert result.gamma[name] == pytest.approx(norm, rel=2e-3)
        assert f"{result.gamma[name]:.3f}" in str(result)
    with pytest.raises(ValueError, match="give at least two"):
        price({"one": (plant, ct.tf([0.5], [1]))}, limit, displacement=displacement)


ONE = ct.tf([1.0], [1.0])
LAG = ct.tf([-5.0], [1.0, 0.4, 100.0])


def weighed(**changed: ct.TransferFunction) -> Weights:
    return Weights(**({"effort": ONE, "uncertainty": 0.1 * ONE, "performance": 0.5 * ONE, "desired": ONE} | changed))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: weighed(uncertainty=ct.tf([1.0], [1.0, -2.0])), r"uncertainty weight has a pole at 2.*must be stable"),
        (lambda: weighed(performance=ct.tf([1.0], [1.0, 0.0])), "performance weight has a pole at 0"),
        (lambda: weighed(performance=ct.tf([1.0, 2.0, 3.0], [1.0, 1.0])), "more zeros than poles"),
        (lambda: weighed(effort=ct.tf([1.0], [1.0, 1.0])), "effort weight vanishes at high frequency"),
        (lambda: weighed(effort=ct.tf([np.nan], [1.0])), "not finite"),
        (lambda: weighed(effort=ct.tf([1.0], [1.0], 0.1)), "discrete"),
        (lambda: mixed_sensitivity(ct.ss(np.eye(2), np.eye(2), np.eye(2), 0), weighed()), "2 inputs and 2 outputs"),
        (lambda: mixed_sensitivity(ct.tf([1.0], [1.0, np.inf]), weighed()), "not finite"),
        (lambda: mixed_sensitivity(LAG, weighed(), relax=0.9), "relax is 0.9"),
        (lambda: mixed_sensitivity(LAG, weighed(), limit=-1.0), "limit is -1"),
        (
            lambda: mixed_sensitivity(LAG, weighed(performance=5 * ONE, uncertainty=5 * ONE)),
            "no controller has a gamma below 3.54 .*exclude each other",
        ),
        (
            lambda: mixed_sensitivity(LAG, weighed(performance=2 * ONE)),
            "smallest gamma is .* above the limit of 1: the .* weight is the tightest",
        ),
        (
            lambda: mixed_sensitivity(ct.ss([[1.0, 0], [0, -1]], [[0.0], [1]], [[1.0, 1]], 0.0), weighed()),
            "no controller stabilises the nominal plant",
        ),
        (lambda: propose_weights(ct.tf([1.0], [1.0, 1.0]), ONE, 1.0, displacement=1.0), "no oscillatory poles"),
        (lambda: propose_weights(ct.tf([1.0], [1.0, -0.1, 1.0]), ONE, 1.0, displacement=1.0), "not stable"),
        (lambda: propose_weights(LAG, ONE, 0.0, displacement=1.0), "torque_limit is 0"),
        (lambda: propose_weights(LAG, ONE, 1.0, displacement=np.nan), "displacement is nan"),
        (
            lambda: propose_weights(LAG, ONE, 1.0, displacement=1.0, band=(20.0, 40.0)),
            "no oscillatory poles from 20 to 40 rad/s, where it was measured",
        ),
        (lambda: propose_weights(LAG, ONE, 1e-6, displacement=1.0), "a torque of 1e-06 adds no damping that counts"),
        (lambda: propose_weights(LAG, 50 * ONE, 1.0, displacement=1.0), "so wide that no damping can be added"),
        (lambda: margins(ct.tf([1.0], [1.0, -1.0]), 0.1 * ONE, weighed()), "closed loop is not stable"),
        (lambda: margins(LAG, ct.ss([[0.5]], [[0.1]], [[0.1]], [[0.0]], True), weighed()), "give its dt in seconds"),
        (lambda: discretise(ONE, LAG, 0.0), "sample_time is 0"),
        (lambda: discretise(-30 * ONE, ct.tf([-5.0], [1.0, 4.0, 100.0]), 0.2), "not stable .* sample faster than every"),
        (lambda: discretise(0.1 * ONE, ct.tf([5.0], [1.0, 1.0, 100.0]), 0.2), "fewer than 4 samples in a period of the res"),
    ],
)  # fmt: skip
def test_bad_input(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_envelopes_that_no_controller_can_be_made_from_are_refused():
    omega = np.linspace(5.0, 20.0, 30)
    sizes = (0.8, 1.0, 1.3)

    def measured(omega=omega, **changed):
        known = dict.fromkeys(("std", "noise_std", "coherence"), np.ones(len(omega)))
        known |= {"odd_distortion": None, "even_distortion": None, "freedom": 9, "input_rms": 1.0, "arm_angle": 0.0}
        parts: dict = known | {"compensated": True} | changed
        return est.FrequencyResponses(
            tuple(
                est.FrequencyResponse(
                    name=f"c{n}", frequency=omega, response=size * np.asarray(LAG(1j * omega)), **parts
                )
                for n, size in enumerate(sizes)
            )
        )

    fit = object.__new__(est.Fit)  # is not looked at before the envelope is
    found = est.envelope(measured(), order_nominal=2, progress=False)
    for covered, responses, message in (
        ([], measured(), "covered: holds no envelope"),
        (est.envelope(measured(), kind="additive", progress=False), measured(), "covered: is additive; control needs"),
        (found, measured(1.1 * omega), "covered: was made of other responses"),
        (found, measured(compensated=False), "c0 is from current to cart_position; give those from current times"),
        (found, measured(input="disturbance_force"), "c0 is from disturbance_force times cos"),
    ):
        with pytest.raises(ValueError, match=message):
            est.control(fit, covered, responses, sample_time=0.01)
    with pytest.raises(ValueError, match=r"displacement: is 15 m; give metres"):
        est.control(fit, found, measured(), sample_time=0.01, displacement=15.0)


def test_bad_reduction(design):
    *_, found = design
    with pytest.raises(ValueError, match="between 1 and 8"):
        reduce_controller(found, order=9)
    with pytest.raises(ValueError, match="loss is -1"):
        reduce_controller(found, loss=-1.0)
    with pytest.raises(ValueError, match="starts at zero"):
        closed_loop(SMOOTH, None, displacement=0.0, duration=0.1).settling_time()
