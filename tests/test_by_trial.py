"""A play, which the likelihood shows by steps only, is found by trial where a fit along derivatives ends beside it."""

import dataclasses

import numpy as np
import pytest
from tqdm import tqdm

import estimators as est
import rtac_jax as rtac
from estimators._by_trial import acting_on
from estimators._search import Search
from rtac_jax import virtual_rig
from rtac_jax.effects import Backlash, Cogging, CubicSpring, CurrentLag, TachoBias


@pytest.mark.parametrize("seed", [77, 87])
def test_a_play_is_found_where_a_fit_along_derivatives_ends_beside_it(seed: int) -> None:
    rig = dataclasses.replace(virtual_rig.Rig().drawn(seed), backlash=0.1, force_noise=1e-3, torque_noise=3e-5)
    plans = virtual_rig.standard_plans(seed=seed + 1, sample_time=0.002, duration=2.0, free=1, forced=2, rest=1)
    recording = virtual_rig.record(rig, plans, seed=seed + 2)
    fit = est.output_error(rtac.RTAC.from_rig(recording), recording, progress=False)
    search = Search.of(fit, recording, [Backlash], tqdm(disable=True))
    base = search.base()
    (play,) = search.quietly(base)
    along, tried = search.with_effect(base, play), search.thoroughly(base, play)
    assert along.values["backlash.gap"] < 0.08
    assert tried.predictor.log_likelihood > along.predictor.log_likelihood + 100
    assert tried.added == ("backlash",)
    assert set(tried.free) == {*base.free, "backlash.gap", "backlash.rotor"}
    truth = {
        "backlash.gap": 0.1, "backlash.rotor": rig.rotor_share, "torque_constant": rig.torque_constant,
        "spring_stiffness": rig.spring_stiffness, "eccentric_moment": rig.eccentric_moment,
    }  # fmt: skip
    for name, value in truth.items():
        assert tried.values[name] == pytest.approx(value, rel=0.05), name


@pytest.mark.parametrize(
    ("port", "moves"),
    [
        (
            "arm",
            {"torque_constant", "arm_viscous.positive", "cogging.cosine", "backlash.gap", "current_lag.time_constant"},
        ),
        ("cart", {"total_mass", "spring_stiffness", "cart_viscous.coefficient", "cubic_spring.stiffness"}),
    ],
)
def test_what_acts_at_its_port_moves_a_contact(port: str, moves: set[str]) -> None:
    added = (CubicSpring(1e4), Cogging(1e-4, 0.0, 7.0), Backlash(0.1, 0.3), CurrentLag(0.01), TachoBias(0.1))
    model = rtac.RTAC.paper()
    for effect in added:
        model = model + effect
    found = set(acting_on(port, model, model.free))
    assert moves <= found
    other = {"arm": "cubic_spring.stiffness", "cart": "cogging.cosine"}[port]
    assert not found & {other, "tacho_bias.bias", "eccentric_moment"}
    assert "current_lag.time_constant" in found
    assert np.all([name in model.free for name in found])
