"""A controller comes back from its file as it was designed: the same matrices, the same sentences."""

import numpy as np
import pytest

import estimators as est
import rtac_jax as rtac
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
