"""The optimiser: where it comes to rest, at kinks too, and what it weighs channels by."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from hidden_effects import recorded

import estimators as est
import rtac_jax as rtac
from estimators.core import jacobian_factor, levenberg_marquardt
from estimators.core.concentrated_noise import ConcentratedNoise
from estimators.core.data import CHANNELS, Data
from estimators.core.fisher_information import information, slope_of
from estimators.core.initial_state import space_of
from estimators.core.jacobian_factor import Arguments, Factors, Passes, Residuals, factor, plain_residual, promised_gain
from estimators.core.levenberg_marquardt import solve
from estimators.core.linearisation import Problem, at_fit
from estimators.core.parameter_space import Unknowns
from estimators.core.residual import diagonal_whitener, no_gain
from rtac_jax import virtual_rig


@pytest.fixture(scope="module")
def problem() -> Problem:
    recording = recorded({"nothing": {}}, first=41)["nothing"]
    return at_fit(est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False), recording)


def away(unknowns: Unknowns, by: float, shift: float = 0.0) -> Unknowns:
    turn = np.cos(np.arange(len(unknowns.shared)) + shift)
    return unknowns._replace(shared=unknowns.shared + by * jnp.asarray(turn))


@pytest.mark.parametrize("most", [1, 3, 60])
def test_factor_is_that_of_the_unknowns(problem: Problem, most: int) -> None:
    arguments, unknowns = problem.arguments, problem.unknowns
    solved = solve(away(unknowns, 0.3), arguments, most=most)
    np.testing.assert_array_equal(solved.factor, np.asarray(factor(solved.unknowns, arguments)))
    np.testing.assert_allclose(solved.cost, 0.5 * np.sum(solved.factor[..., -1] ** 2), rtol=1e-9)


def test_channels_are_weighted_by_what_is_left_of_them(problem: Problem) -> None:
    noise = ConcentratedNoise.of(problem.arguments.data)
    whitener = problem.arguments.whitener * jnp.asarray([3.0, 0.2, 1.0])[:, None, None]  # wrong levels to begin with
    arguments = dataclasses.replace(problem.arguments, whitener=whitener)
    solved = solve(away(problem.unknowns, 0.05), arguments, noise=noise)
    assert solved.converged
    error = np.asarray(plain_residual(solved.unknowns, arguments)[0])
    left = np.sum(error**2, axis=(0, 2))
    np.testing.assert_allclose(solved.squares, left, rtol=1e-9)
    # In its factor every channel that was measured has the squares of as many samples of noise one, and the slope is none.
    assert promised_gain(solved.factor, len(solved.unknowns.shared)) < 1e-4
    weighted = Passes(arguments).factors(solved.unknowns).joined(1.0 / noise.deviations(left))
    np.testing.assert_allclose(solved.factor, weighted, rtol=1e-7, atol=1e-7)
    known = 0.5 * np.sum(weighted[..., -1] ** 2) - 0.5 * np.sum(noise.counts)
    assert solved.cost == pytest.approx(
        np.sum(noise.counts[left > 0] * np.log(noise.deviations(left)[left > 0])) + known
    )
    # Whatever the optimiser believes of slopes: by simulations the likelihood falls to either side.
    deviations = np.sqrt(np.diagonal(information(solved.factor, arguments.space, solved.unknowns).covariance))
    for place, one in enumerate(deviations / slope_of(arguments.space, solved.unknowns)):
        for sign in (1.0, -1.0):
            beside = solved.unknowns._replace(shared=solved.unknowns.shared.at[place].add(sign * one))
            there = np.sum(np.asarray(plain_residual(beside, arguments)[0]) ** 2, axis=(0, 2))
            assert noise.cost(there) > noise.cost(left)
    # The levels to begin with are no matter: they change the cost by a constant, and nothing else.
    plainly = solve(away(problem.unknowns, 0.05), problem.arguments, noise=noise)
    np.testing.assert_allclose(solved.unknowns.shared, plainly.unknowns.shared, atol=1e-6)


def test_what_is_rejected_is_only_simulated(problem: Problem, monkeypatch: pytest.MonkeyPatch) -> None:
    passes, simulations = [], []
    whole, plain = Passes.factors, Residuals.at
    monkeypatch.setattr(Passes, "factors", lambda self, at: (passes.append(at), whole(self, at))[1])
    monkeypatch.setattr(Residuals, "at", lambda self, at: (simulations.append(1), plain(self, at))[1])
    solved = solve(away(problem.unknowns, 1.2), problem.arguments)
    assert len(passes) == solved.steps + 1
    assert len(simulations) > 2  # the first step was too long
    cost = [0.5 * np.sum(np.asarray(plain_residual(at, problem.arguments)[0]) ** 2) for at in passes]
    assert sum(np.diff(cost) > 0) <= len(passes) // 3


def bent(at: Unknowns) -> tuple[np.ndarray, float]:
    """A residual with a kink along the line x = y, as dry friction makes them, and its slope across that."""
    x, y = np.asarray(at.shared)
    return np.array([10 * abs(y - x) + 3, np.sinh(x + y - 2)]), 10.0 * float(np.sign(y - x))


def bent_residual(_: Residuals, at: Unknowns) -> tuple[np.ndarray, np.ndarray]:
    return bent(at)[0].reshape(-1, 1, 1), np.zeros((0, 1))


def bent_factors(_: Passes, at: Unknowns) -> Factors:
    value, slope = bent(at)
    other = float(np.cosh(np.sum(np.asarray(at.shared)) - 2))
    return Factors(np.array([[-slope, slope, value[0]], [other, other, value[1]]])[None, None], np.zeros((1, 0, 3)))


@pytest.mark.parametrize(("beside", "reached"), [(levenberg_marquardt._BESIDE, True), (0, False)])
def test_a_kink_is_followed_to_the_least(
    problem: Problem, beside: int, reached: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(levenberg_marquardt, "_BESIDE", beside)
    monkeypatch.setattr(Passes, "factors", bent_factors)
    monkeypatch.setattr(Residuals, "at", bent_residual)
    begin = Unknowns(jnp.asarray([3.0, 3.5]), jnp.zeros((0, 1)), jnp.zeros((0, 1)))
    solved = solve(begin, problem.arguments, most=200)
    assert (solved.cost < 4.5 + 1e-2) == reached
    assert solved.converged
    if reached:
        np.testing.assert_allclose(solved.unknowns.shared, 1.0, atol=0.1)


def test_slopes_beyond_all_bounds_do_not_count(problem: Problem, monkeypatch: pytest.MonkeyPatch) -> None:
    def wild(passes: Passes, at: Unknowns) -> Factors:
        found = bent_factors(passes, at)
        steep = bent(at)[1] < 0  # on one side of the kink
        return dataclasses.replace(found, channels=np.where(steep & (found.channels != 0), 1e175, found.channels))

    monkeypatch.setattr(Passes, "factors", wild)
    monkeypatch.setattr(Residuals, "at", bent_residual)
    begin = Unknowns(jnp.asarray([3.0, 3.5]), jnp.zeros((0, 1)), jnp.zeros((0, 1)))
    solved = solve(begin, problem.arguments, most=50)
    assert np.all(np.isfinite(solved.factor))
    assert solved.cost < 0.5 * np.sum(bent(begin)[0] ** 2)


@pytest.mark.parametrize("count", [8, pytest.param(9, marks=pytest.mark.slow)])
def test_halves_make_the_whole(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    plans = virtual_rig.standard_plans(seed=3, duration=0.5, free=count - 4, forced=4)
    recording = virtual_rig.record(virtual_rig.Rig(), plans, seed=3)
    recording = dataclasses.replace(recording, rig_std={"arm_inertia": 1e-7})
    model = rtac.RTAC.from_rig(recording).each_experiment("cart_coulomb.level")
    experiments = recording.experiments
    data = Data.of(experiments)
    space = space_of(model, experiments, free=[n for n in model.free if n not in model.per_experiment])
    assert space.known is not None
    unknowns = space.unconstrained()
    arguments = Arguments(model, data, space, diagonal_whitener(np.ones(len(CHANNELS)), data), no_gain(model, data), 1)
    halves = Passes(arguments).factors(unknowns)
    monkeypatch.setattr(jacobian_factor, "_HALVED", 100)
    whole = Passes(arguments).factors(unknowns)
    for mine, others in ((halves.channels, whole.channels), (halves.prior, whole.prior)):
        lengths = np.maximum(np.linalg.norm(others, axis=-2, keepdims=True), 1e-300)
        products, expected = (np.swapaxes(rows / lengths, -1, -2) @ (rows / lengths) for rows in (mine, others))
        np.testing.assert_allclose(products, expected, atol=1e-8)


def test_an_arc_ends_where_what_it_promises_is_rounding(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a cost of 2.5e15 rounding never promises less than 0.3, however short the step."""

    class Rounded(levenberg_marquardt._Arc):
        def __init__(self) -> None:
            self.asked = 0

        def at(self, damping: float) -> tuple[Any, float]:
            self.asked += 1
            assert self.asked < 100
            return None, max(1e15 / damping, 0.5)

    monkeypatch.setattr(levenberg_marquardt._Walk, "_simulated_cost", lambda *_: 2.5e15)
    walk = object.__new__(levenberg_marquardt._Walk)
    found = walk._along(Rounded(), 1.0, 2.5e15, np.ones(3))
    assert found.there is None


@pytest.mark.parametrize("beside", [0.0, 1e9])
def test_a_step_promises_what_it_moves_however_large_is_what_no_step_moves(beside: float) -> None:
    """As slopes that are seen from beyond a kink are: rounding of such a sum of squares promised 0.03 without end."""
    unknowns = Unknowns(jnp.zeros(1), jnp.zeros((0, 1)), jnp.zeros((0, 1)))
    arc = levenberg_marquardt._Arc(unknowns, np.array([[1.0, 2.0], [0.0, beside]]))
    for damping in (1e-6, 1.0, 1e12, np.inf):
        step, promised = arc.at(damping)
        moved = 2.0 / (1.0 + damping)
        assert float(step.shared[0]) == pytest.approx(-moved, rel=1e-9, abs=1e-30)
        assert promised == pytest.approx(2.0 * moved - 0.5 * moved**2, rel=1e-9, abs=1e-30)


class Scripted:
    """Steps that gain what is written, of a channel whose deviation stays as it is."""

    def __init__(self, gains: list[float]) -> None:
        self.gains, self.steps, self.full = gains, 0, False

    def step(self, unknowns: Unknowns, best: Any, weights: Any, promised: float) -> Any:
        gained = self.gains[min(self.steps, len(self.gains) - 1)]
        self.steps += 1
        moved = unknowns._replace(shared=unknowns.shared + 1.0)
        return levenberg_marquardt._Taken(moved, HERE, gained)


SAMPLES, OFF = 2000, 50.0
HERE = Factors(OFF * np.sqrt(SAMPLES) * np.ones((1, 1, 1, 2)), np.zeros((1, 0, 2)))


@pytest.mark.parametrize(
    ("gains", "promised", "far", "steps", "crept"),
    [
        ([100.0, 5.0, 4.0, 3.0], 900.0, 10.0, 4, True),
        ([100.0, 5.0, 4.0, 90.0, 5.0, 4.0, 3.0], 900.0, 10.0, 7, True),  # in a row
        ([5.0], 900.0, 60.0, 20, False),  # near the noise every step counts
        ([5.0], 900.0, np.inf, 20, False),
        ([5.0], 5.5, 10.0, 20, False),  # what is promised is gained: it converges
    ],
)
def test_a_descent_that_creeps_far_from_the_data_is_ended(
    problem: Problem,
    gains: list[float],
    promised: float,
    far: float,
    steps: int,
    crept: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    walk = Scripted(gains)
    monkeypatch.setattr(levenberg_marquardt, "_Walk", lambda *_: walk)
    monkeypatch.setattr(levenberg_marquardt, "Passes", lambda _: SimpleNamespace(factors=lambda _: HERE))
    monkeypatch.setattr(levenberg_marquardt, "promised_gain", lambda *_: promised)
    nowhere = Unknowns(jnp.zeros(1), jnp.zeros((0, 1)), jnp.zeros((0, 1)))
    noise = ConcentratedNoise(np.array([float(SAMPLES)]))
    solved = solve(nowhere, problem.arguments, most=20, noise=noise, far=far)
    assert (solved.steps, solved.crept, solved.converged) == (steps, crept, False)
