"""A controller comes back from its file as it was designed: the same matrices, the same sentences."""

import dataclasses

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
from estimators.controller.design import _doubt, _drawn
from estimators.reporting.summary import of_control
from rtac_jax import virtual_rig
from rtac_jax.control import (
    Actuation,
    ClosedLoop,
    Units,
    discretise,
    margins,
    mixed_sensitivity,
    paper_nominal,
    paper_weights,
    reduce_controller,
)


def loop(plants, seed):
    """Made-up responses that decay, each at its own rate."""
    time = np.arange(400) * 0.01
    rates = np.random.default_rng(seed).uniform(0.5, 2, plants)
    position = 0.015 * np.exp(-np.outer(time, rates)) * np.cos(10 * time)[:, None]
    return ClosedLoop(time, position, 0.1 * position, position, 0.001 * position, 0.1)


@pytest.fixture(scope="module")
def design():
    omega = np.linspace(2, 60, 60)
    random = np.random.default_rng(0)
    plants = np.stack([1 / ((1j * omega) ** 2 + z * 1j * omega + 170) for z in random.uniform(4, 6, 6)])
    covered = est.envelope(plants, omega=omega, order_nominal=2, within_db=40.0, progress=False)
    synthesis = mixed_sensitivity(paper_nominal(), paper_weights())
    reduction = reduce_controller(synthesis)
    sampled = discretise(reduction.controller, synthesis.nominal, 0.01)
    model = rtac.RTAC.paper()
    return est.ControlDesign(
        covered, Units.nondimensional(model), Actuation.proposed(model, motor_limit=0.1), paper_weights(), synthesis, reduction,
        margins(synthesis.nominal, sampled, paper_weights()), reduction.controller, sampled, 0.015, 3.0, loop(1, 1), loop(1, 2),
        loop(50, 3), loop(50, 4), None, 0.01, loop(50, 5), None, (0.598, 25.0),
    )  # fmt: skip


def test_a_controller_comes_back_bit_for_bit(design, tmp_path):
    design.save(tmp_path / "controller.h5")
    loaded = est.load(tmp_path / "controller.h5")
    assert str(loaded) == str(design)
    assert loaded._repr_html_() == design._repr_html_()
    assert loaded.fractions == design.fractions
    for name in ("controller", "sampled"):
        here, there = getattr(design, name), getattr(loaded, name)
        for part in "ABCD":
            assert np.array_equal(getattr(here, part), getattr(there, part))
        assert here.dt == there.dt
        assert (here.input_labels, here.output_labels, here.state_labels, here.name) == (
            there.input_labels, there.output_labels, there.state_labels, there.name,
        )  # fmt: skip
    omega = np.linspace(1, 200, 50)
    assert np.array_equal(loaded.weights.w1(1j * omega), design.weights.w1(1j * omega))
    assert np.array_equal(loaded.synthesis.nominal(1j * omega), design.synthesis.nominal(1j * omega))
    assert loaded.reduction.tried == design.reduction.tried
    assert np.array_equal(loaded.off.settling_time(), design.off.settling_time())
    assert loaded.off.cart_position.tobytes() == design.off.cart_position.tobytes()


def test_a_model_that_does_not_follow_the_rig_is_said_before_what_the_controller_does_for_it(design):
    near, far = (dataclasses.replace(design, farthest=ratio) for ratio in (2.0, 30.0))
    assert "does not follow the rig" not in str(near)
    assert "does not follow the rig, being left at 30 times the noise" in str(far)
    assert "left at 30 times the noise" in of_control(far, []).sure
    assert "left at 30 times the noise" not in of_control(near, []).sure


def test_what_may_be_nothing_is_named_and_counts_as_no_deviation(design):
    named = dataclasses.replace(design, nothing=("cart_coulomb.level",))
    assert "no free parameter but cart_coulomb.level, not told from nothing, has a standard deviation above 1 %" in str(
        named
    )
    assert "in which no free parameter has a standard deviation above 1 %" in str(design)


def test_parameters_near_nothing_are_drawn_on_their_side_and_do_not_pile_up_on_the_estimate():
    rtac.configure()
    plans = virtual_rig.standard_plans(seed=1, sample_time=0.01, duration=3.0, free=2, forced=1)
    recording = virtual_rig.record(virtual_rig.Rig(cart_coulomb=0.0, cart_viscous=0.5), plans, seed=2)
    model = rtac.RTAC.from_rig(recording).with_values({"cart_coulomb.level": 1e-4})
    fit = est.output_error(model, recording, from_model=True, progress=False)
    level = fit.parameters["cart_coulomb.level"]
    doubt, nothing = _doubt(fit)
    assert ("cart_coulomb.level" in nothing) == (level.std >= 0.5 * level.value)
    assert doubt < 0.5
    drawn = np.asarray(_drawn(fit).values["cart_coulomb.level"])
    assert np.all(drawn >= 0)
    assert len(np.unique(drawn)) == len(drawn)
    others = np.asarray(_drawn(fit).values["spring_stiffness"])
    assert np.std(others) == pytest.approx(fit.parameters["spring_stiffness"].std, rel=0.1)
