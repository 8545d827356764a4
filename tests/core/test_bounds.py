"""A fit that begins on a bound leaves it where the data say so, and never says that it converged there otherwise."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from estimators.core import active_bounds as _bounds
from estimators.core.active_bounds import solve_bounded
from estimators.core.data import Data
from estimators.core.initial_state import space_of
from estimators.core.levenberg_marquardt import Arguments
from estimators.core.linearisation import at_fit
from estimators.core.residual import diagonal_whitener, no_gain
from estimators.diagnosis.candidate_set import plausible
from rtac_jax import Scales, effects, virtual_rig
from rtac_jax.parameters import declarations
from rtac_jax.simulation import substeps_for

CASES = {
    "arm_coulomb.level": ("arm_coulomb", 1.5e-4, effects.ArmCoulomb),
    "cart_quadratic_drag.coefficient": ("cart_quadratic_drag", 1.0, effects.CartQuadraticDrag),
    "cart_coulomb.level": (None, 0.024, None),
    "arm_viscous.positive": (None, 1.39e-4, None),
}


@pytest.fixture(scope="module")
def recordings():
    hidden = {name: {field: size} if field else {} for name, (field, size, _) in CASES.items()}
    plans = virtual_rig.standard_plans(seed=1, duration=2.0, free=2, forced=2)
    return {
        name: virtual_rig.record(dataclasses.replace(virtual_rig.Rig(), **changes), plans, seed=2)
        for name, changes in hidden.items()
    }


@pytest.mark.parametrize("name", CASES)
def test_a_fit_from_the_null_finds_what_there_is(recordings, name):
    _, truth, cls = CASES[name]
    model = rtac.RTAC.from_rig(recordings[name])
    model = model + cls(0.0) if cls else model.with_values({name: 0.0})
    fit = est.output_error(model, recordings[name], from_model=True, progress=False)
    assert fit.result == est.RESULTS.successful
    found = fit.parameters[name]
    assert abs(found.value - truth) < 4.0 * found.std
    assert found.value > 0.5 * truth


@pytest.mark.parametrize("name", [name for name in CASES if name != "arm_viscous.positive"])
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
    left = solve_bounded(away, problem.arguments)
    assert left.pulled
    assert left.cost > best.cost + 10.0


def on_their_bounds():
    """Parameters of the catalogue that say that their effect is absent where they are on a bound."""
    # A short run at the travel and current of these reaches neither the stop nor the limit of the amplifier.
    unseen = {"end_stop", "saturation"}
    scales = Scales(
        position=0.01, velocity=0.1, arm_velocity=10.0, current=0.3, force=1.3, torque=0.03, frequency=10.4, mass=1.23,
        sample_time=0.005,
    )  # fmt: skip
    for cls in effects.CATALOGUE.values():
        for name, declared in declarations(cls).items():
            if cls.id in unseen or declared.null not in declared.bounds:
                continue
            if found := plausible(cls, scales):
                yield pytest.param(found[len(found) // 2], name, id=f"{cls.id}.{name}")


@pytest.mark.slow
@pytest.mark.parametrize(("effect", "name"), list(on_their_bounds()))
def test_every_parameter_of_the_catalogue_leaves_its_bound(effect, name):
    """From the model's own simulation: what counts here is the way from the bound to the truth, not the physics."""
    plans = virtual_rig.standard_plans(seed=1, duration=1.5, free=1, forced=1)
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
    # Where starts make up for a part of it, or nothing shows it, the cost says so.
    assert found == pytest.approx(known[which], rel=0.02) or solved.cost < 1.0
