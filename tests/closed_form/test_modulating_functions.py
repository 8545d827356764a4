"""The integrals of the weak form against analytic ones and finer grids."""

import numpy as np
import pytest

import rtac_jax as rtac
from estimators.closed_form.modulating_functions import ModulatingFunctions, integrated_sign


def test_test_functions_integrate_derivatives_by_parts() -> None:
    dt = 0.005
    time = dt * np.arange(400)
    on = ModulatingFunctions(400, dt, 0.25)
    signal, slope, bend = np.sin(9 * time), 9 * np.cos(9 * time), -81 * np.sin(9 * time)
    np.testing.assert_allclose(on(signal, 1), on(slope), atol=1e-9)
    np.testing.assert_allclose(on(signal, 2), on(bend), atol=1e-8)


def test_a_held_input_is_integrated_exactly() -> None:
    """Against the same input on a grid a hundred times finer."""
    dt, fine = 0.01, 100
    held = np.where(np.arange(200) // 7 % 2 == 0, 1.0, -0.5)
    on = ModulatingFunctions(200, dt, 0.3)
    experiment = rtac.Experiment.of(
        "a", kind="forced", sample_time=dt, current=held, cart_position=np.sin(np.arange(200.0))
    )
    found = on.of_input(experiment.inputs["current"])
    s = (np.arange(-on.m * fine, on.m * fine) + 0.5) / (on.m * fine)
    first = on.middle[3] - on.m
    expected = np.sum(np.repeat(held[first : first + 2 * on.m], fine) * (1 - s**2) ** 6) * dt / fine
    assert found[3] == pytest.approx(expected, rel=1e-6)


def test_integrated_sign_is_exact_between_the_turns_of_a_straight_velocity() -> None:
    time = 0.1 * np.arange(11)
    turn = 0.43
    found = integrated_sign(turn - time, 0.1)
    np.testing.assert_allclose(found.values, turn - np.abs(time - turn), atol=1e-12)
    fine = np.linspace(0.0, 1.0, 100001)
    assert found.integral[-1] == pytest.approx(np.trapezoid(turn - np.abs(fine - turn), fine), abs=1e-8)
