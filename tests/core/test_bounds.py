"""A fit that begins on a bound leaves it where the data say so, and never says that it converged there otherwise."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from estimators.core import active_bounds as _bounds
from estimators.core import bound_transform
from estimators.core.active_bounds import solve_bounded
from estimators.core.bound_transform import slopes, to_physical
from estimators.core.data import Data
from estimators.core.fisher_information import each_deviations, information, information_of
from estimators.core.initial_state import space_of
from estimators.core.jacobian_factor import Arguments, factor
from estimators.core.linearisation import at_fit
from estimators.core.residual import diagonal_whitener, no_gain
from estimators.diagnosis.candidate_set import plausible
from estimators.reporting.tables import parameter_table
from rtac_jax import Scales, effects, virtual_rig
from rtac_jax.parameters import declarations
from rtac_jax.simulation import substeps_for

CASES = {
    "arm_coulomb.level": ("arm_coulomb", 1.5e-4, effects.ArmCoulomb),
    "cart_quadratic_drag.coefficient": ("cart_quadratic_drag", 1.0, effects.CartQuadraticDrag),
    "cart_coulomb.level": (None, 0.024, None),
    "arm_viscous.positive": (None, 1.39e-4, None),
}
MARKED = {name: pytest.param(name, marks=[pytest.mark.slow] * name.startswith("cart_quadratic")) for name in CASES}


@pytest.fixture(scope="module")
def recordings():
    hidden = {name: {field: size} if field else {} for name, (field, size, _) in CASES.items()}
    plans = virtual_rig.standard_plans(seed=1, duration=2.0, free=2, forced=2)
    return {
        name: virtual_rig.record(dataclasses.replace(virtual_rig.Rig(), **changes), plans, seed=2)
        for name, changes in hidden.items()
    }


@pytest.mark.parametrize("name", MARKED.values())
def test_a_fit_from_the_null_finds_what_there_is(recordings, name):
    _, truth, cls = CASES[name]
    model = rtac.RTAC.from_rig(recordings[name])
    model = model + cls(0.0) if cls else model.with_values({name: 0.0})
    fit = est.output_error(model, recordings[name], from_model=True, progress=False)
    assert fit.result == est.RESULTS.successful
    found = fit.parameters[name]
    assert abs(found.value - truth) < 4.0 * found.std
    assert found.value > 0.5 * truth


def test_a_direction_that_nothing_shows_is_not_called_absent():
    """A motor that turns one way ended with friction of the other on its bound, 1.2e-7 +- 0.0027 beside 6.7e-4."""
    model = rtac.RTAC.paper().with_values({"arm_viscous.positive": 6.7e-4, "arm_viscous.negative": 1e-7})
    names = ("arm_viscous.positive", "arm_viscous.negative")
    for std, told in ((2.7e-3, "where these data hardly show it"), (1e-5, "the data ask for no such term")):
        known = information_of(np.diag([1 / 2.4e-5, 1 / std]), names, np.ones(2))
        fit = est.Fit(model, est.RESULTS.successful, known, {}, {}, {}, (), {"agreed": 2, "starts": 2})
        assert f"arm_viscous.negative ended on its bound, 0{',' if 'hardly' in told else ':'} {told}" in fit.outcome


def test_an_estimate_that_stays_on_its_bound_is_named(recordings):
    """Where a fit holds it, a ten thousandth of its deviation off; one that is a deviation off is not there."""
    recording = recordings["arm_coulomb.level"]
    model = rtac.RTAC.from_rig(recording)
    ended = est.output_error(model + effects.ArmCoulomb(1e-4), recording, progress=False)
    std = ended.parameters["arm_coulomb.level"].std
    fit, without = (
        dataclasses.replace(ended, model=ended.model.with_values({"arm_coulomb.level": times * std}))
        for times in (1e-4, 1.0)
    )
    assert fit.on_bounds() == {"arm_coulomb.level": 0.0}
    assert "arm_coulomb.level ended on its bound, 0: the data ask for no such term" in fit.outcome
    lost = dataclasses.replace(fit, residual_std={c: 100.0 * fit.noise[c] for c in fit.residual_std})
    assert "arm_coulomb.level ended on its bound, 0, which tells nothing" in lost.outcome
    assert "ask for no such term" not in lost.outcome
    row = next(row for row in parameter_table(fit).rows if row[0] == "arm_coulomb.level")
    assert row[2].endswith(", on its bound")
    assert without.on_bounds() == {}
    assert "bound" not in without.outcome
    # By the deviation of what the data leave free every value is near every bound.
    known = fit.information
    place = known.names.index("arm_coulomb.level")
    apart = known.covariance.copy()
    apart[place, place] *= 1e12
    directions = np.roll(np.eye(len(known.names)), -place, axis=0)
    deviations = np.geomspace(1e5, 1e-3, len(directions))
    free = dataclasses.replace(known, covariance=apart, directions=directions, deviations=deviations)
    assert dataclasses.replace(fit, information=free).on_bounds() == {}


@pytest.mark.parametrize("name", [MARKED[name] for name in CASES if name != "arm_viscous.positive"])
def test_an_estimate_on_its_bound_that_is_pulled_inwards_is_released_or_said(recordings, name, monkeypatch):
    recording = recordings[name]
    _, truth, cls = CASES[name]
    model = rtac.RTAC.from_rig(recording)
    problem = at_fit(est.output_error(model + cls(truth) if cls else model, recording, progress=False), recording)
    best = solve_bounded(problem.unknowns, problem.arguments)
    space = problem.arguments.space
    values = np.asarray(space.values).copy()
    values[space.names.index(name)] = 0.0
    away = dataclasses.replace(space, values=jnp.asarray(values)).unconstrained()._replace(start=problem.unknowns.start)
    assert float(np.min(np.asarray(away.shared))) < -500.0  # as good as on the bound
    released = solve_bounded(away, problem.arguments)
    assert released.cost == pytest.approx(best.cost, rel=1e-3) or not released.converged
    assert not released.pulled
    if name != "cart_coulomb.level":
        return  # they creep off it, and the steps may run out
    assert released.converged
    monkeypatch.setattr(_bounds, "_TURNS", 1)
    left = solve_bounded(away, problem.arguments, most=0)
    assert left.pulled == (name,)
    assert left.cost > best.cost + 10.0
    crept = solve_bounded(away, problem.arguments)  # what would creep is damped less, and leads off the bound by itself
    assert crept.cost == pytest.approx(best.cost, rel=1e-3)


@pytest.fixture(scope="module")
def fitted(recordings):
    recording = recordings["cart_coulomb.level"]
    return recording, est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)


@pytest.mark.parametrize("side", [-1, 1])
def test_a_parameter_between_two_bounds_leaves_either_of_them(fitted, side):
    recording, fit = fitted
    problem = at_fit(fit, recording)
    space, place = problem.arguments.space, problem.names.index("spring_stiffness")
    index = space.names.index("spring_stiffness")
    value = float(space.values[index])
    lower, upper = space.lower.at[index].set(0.995 * value), space.upper.at[index].set(1.01 * value)
    arguments = dataclasses.replace(problem.arguments, space=dataclasses.replace(space, lower=lower, upper=upper))
    end = side * _bounds._end(0.995 * value, 1.01 * value)
    there = problem.unknowns._replace(shared=problem.unknowns.shared.at[place].set(end))
    full = np.asarray(factor(there, arguments))
    held, _ = _bounds._on_bounds(arguments.space, there, full, {place: end})
    assert place not in held
    released = solve_bounded(there, arguments)
    best = solve_bounded(problem.unknowns, problem.arguments)
    assert released.cost == pytest.approx(best.cost, rel=1e-4)
    assert not released.pulled


@pytest.mark.slow
def test_a_parameter_of_each_experiment_leaves_its_bound(fitted, monkeypatch):
    recording, fit = fitted
    model = fit.model.each_experiment("cart_coulomb.level")
    own = est.output_error(model.with_values({"cart_coulomb.level": 0.0}), recording, from_model=True, progress=False)
    assert own.result == est.RESULTS.successful
    levels = np.asarray(own.model["cart_coulomb.level"])
    problem = at_fit(own, recording)
    std = each_deviations(
        np.asarray(factor(problem.unknowns, problem.arguments)), problem.arguments.space, problem.unknowns
    )
    assert np.all(np.abs(levels - CASES["cart_coulomb.level"][1]) < 4.0 * std[0])
    assert np.all(levels > 0.5 * CASES["cart_coulomb.level"][1])
    best = solve_bounded(problem.unknowns, problem.arguments)
    away = problem.unknowns._replace(each=jnp.full_like(problem.unknowns.each, -1e4))
    monkeypatch.setattr(_bounds, "_TURNS", 1)
    left = solve_bounded(away, problem.arguments)
    assert left.pulled == ("cart_coulomb.level",)
    assert left.cost > best.cost + 10.0
    monkeypatch.undo()
    released = solve_bounded(away, problem.arguments)
    assert not released.pulled
    assert released.cost == pytest.approx(best.cost, rel=1e-3)


def test_predictions_from_the_null_find_what_there_is(fitted):
    recording, fit = fitted
    null = fit.model.with_values({"cart_coulomb.level": 0.0})
    found = est.prediction_error_nonlinear(null, recording, from_model=True, progress=False)
    level = found.parameters["cart_coulomb.level"]
    assert abs(level.value - CASES["cart_coulomb.level"][1]) < 4.0 * level.std
    assert level.value > 0.5 * CASES["cart_coulomb.level"][1]


def test_a_profile_begins_off_a_bound(fitted):
    """What else the fit says to be zero is fitted again at each point, and at the estimate itself."""
    recording, fit = fitted
    null = dataclasses.replace(fit, model=fit.model.with_values({"arm_viscous.positive": 0.0}))
    found, same = (est.profile(f, recording, "torque_constant", points=3, reach=2.0) for f in (null, fit))
    np.testing.assert_allclose(found.rise, same.rise, rtol=0.02, atol=0.02)


SCALES = Scales(
    position=0.01, velocity=0.1, arm_velocity=10.0, current=0.3, force=1.3, torque=0.03, frequency=10.4, mass=1.23,
    sample_time=0.005, applied_force=0.2,
)  # fmt: skip
# Of these the stop is touched, and the amplifier at its limit, in the short runs below.
TIGHT = {
    "end_stop": dataclasses.replace(SCALES, position=0.007),
    "saturation": dataclasses.replace(SCALES, current=0.05),
}


# What leaves its bound and ends in another minimum than the truth.
ELSEWHERE = {
    "arm_presliding.level": "the start of the arm makes up for friction, and the fit creeps back to the bound, not converged",
}


def on_their_bounds():
    """Parameters of the catalogue that say that their effect is absent where they are on a bound."""
    for cls in effects.CATALOGUE.values():
        for name, declared in declarations(cls).items():
            if declared.null not in declared.bounds:
                continue
            if found := plausible(cls, TIGHT.get(cls.id, SCALES)):
                which = f"{cls.id}.{name}"
                reason = ELSEWHERE.get(which)
                marks = [pytest.mark.xfail(reason=reason, strict=True)] if reason else []
                yield pytest.param(found[len(found) // 2], name, id=which, marks=marks)


UNSEEN = {"saturation.inverse_limit", "force_saturation.inverse_limit"}  # without any slope at its null


@pytest.mark.slow
@pytest.mark.parametrize(("effect", "name"), list(on_their_bounds()))
def test_every_parameter_of_the_catalogue_leaves_its_bound(effect, name):
    """From the model's own simulation: what counts here is the way from the bound to the truth, not the physics."""
    plans = virtual_rig.standard_plans(seed=1, duration=1.5, free=1, forced=1)
    if effect.port == "force drive":
        force = 0.3 * np.sin(9.0 * plans[1].sample_time * np.arange(plans[1].samples))
        plans = (*plans, dataclasses.replace(plans[1], name="pushed", disturbance_force=force))
    recording = virtual_rig.record(virtual_rig.Rig(encoder=True), plans, seed=2)
    model = rtac.RTAC.from_rig(recording).with_values({"cart_coulomb.level": 0.02})
    model = model if any(e.id == effect.id for e in model.effects) else model + effect
    known = {n: float(np.asarray(model[n])) for n in model.parameters}
    moving = [e for e in recording if e.kind != "rest"]
    start = {e.name: np.array([0.015 * (e.kind == "free"), 0.0, e.initial_arm_angle or 0.0, 0.0]) for e in moving}
    simulated = rtac.simulate(model, moving, start=start)
    told = [
        dataclasses.replace(
            e, outputs={c: dataclasses.replace(s, values=getattr(simulated[e.name], c)) for c, s in e.outputs.items()}
        )
        for e in moving
    ]
    which = f"{effect.id}.{name}"
    null = declarations(type(effect))[name].null
    space = space_of(model.with_values({which: null}), told, free=[which], start=start)
    scale = np.asarray(space.scale).copy()
    scale[space.names.index(which)] = abs(known[which])
    space = dataclasses.replace(space, scale=jnp.asarray(scale))
    data = Data.of(told)
    white = diagonal_whitener(np.array([2e-5, 0.05, 1e-3]), data)
    arguments = Arguments(
        model, data, space, white, no_gain(model, data), substeps_for(model, data.excitation, stability=0.5)
    )
    begin = space.unconstrained()
    solved = solve_bounded(begin, arguments)
    assert not solved.pulled
    found = float(np.asarray(space.physical(solved.unknowns)[0])[space.names.index(which)])
    # Where starts make up for a part of it, or nothing shows it, the cost says so; a limit beyond all that happens has no slope
    # from which a fit could know of it.
    free = information(solved.factor, space, solved.unknowns).undetermined()
    assert (
        found == pytest.approx(known[which], rel=0.02)
        or solved.cost < 1.0
        or (which in UNSEEN and free == [f"{which} has no effect on what was measured"])
    )


def test_slopes_are_exact_however_close_to_a_bound():
    def value(*given):
        return bound_transform._value_and_slope(*given, xp=jnp)[0]

    z = np.array([-1e9, -1e5, -30.0, -2.0, 0.0, 3.0, 20.0, 1e4])
    for low, high in ((0.0, np.inf), (-np.inf, 1.0), (0.2, 1.0), (-np.inf, np.inf)):
        bounds = [np.full(len(z), x) for x in (low, high, 2.0)]
        # By JAX from the values alone, and not by the rule that `to_physical` gives it.
        exact = jax.vmap(jax.grad(value))(*(jnp.asarray(x) for x in (z, *bounds)))
        np.testing.assert_allclose(slopes(z, *bounds), exact, rtol=1e-6)
        by_rule = jax.vmap(jax.grad(to_physical))(*(jnp.asarray(x) for x in (z, *bounds)))
        np.testing.assert_allclose(by_rule, exact, rtol=1e-6)
        assert (low, high) == (0.2, 1.0) or np.all(slopes(z, *bounds) > 0)


def test_what_shows_nothing_at_all_is_undetermined():
    for matrix in (np.zeros((3, 2)), np.diag([1.0, 0.0]), 1e-200 * np.eye(2)):
        found = information_of(matrix, ("a", "b"), np.array([1e-4, 1e4]))
        assert np.all(np.isfinite(found.covariance))
        assert "b has no effect on what was measured" in found.undetermined() or "scaled" in str(found.undetermined())


@pytest.mark.parametrize(("more", "pulled"), [(0.9, False), (5.0, True)])
def test_what_was_released_and_ends_no_better_is_pulled_no_longer(fitted, monkeypatch, more, pulled):
    """At a bound a pull of less than two deviations is chance; one that leads to a worse place has not been followed."""
    recording, fit = fitted
    problem = at_fit(fit, recording)
    best = solve_bounded(problem.unknowns, problem.arguments)
    costs = iter((100.0, 100.0 + more))
    inside = iter(({0: float(np.asarray(problem.unknowns.shared)[0])}, {}))
    monkeypatch.setattr(_bounds, "solve", lambda *_, **__: best._replace(cost=next(costs)))
    monkeypatch.setattr(_bounds, "_on_bounds", lambda *_: ({}, next(inside)))
    found = solve_bounded(problem.unknowns, problem.arguments)
    assert (found.cost, bool(found.pulled)) == (100.0, pulled)


def test_where_what_was_released_diverges_it_is_named_and_what_stays_held_is_not(fitted, monkeypatch):
    recording, fit = fitted
    problem = at_fit(fit, recording)
    best = solve_bounded(problem.unknowns, problem.arguments)
    turns = iter([best, best])
    belong = iter([({0: -1.0, 1: -1.0}, {}), ({1: -1.0}, {})])

    def solved(*_, **__):
        if (found := next(turns, None)) is None:
            raise FloatingPointError
        return found

    monkeypatch.setattr(_bounds, "solve", solved)
    monkeypatch.setattr(_bounds, "_on_bounds", lambda *_: next(belong))
    space = problem.arguments.space
    assert solve_bounded(problem.unknowns, problem.arguments).pulled == (space.names[int(space.active[0])],)
