"""A learned curve has no slope that the model's spring or its viscous friction has already."""

import numpy as np
import pytest

from estimators.misspecification.static_force import ForceCurve


@pytest.mark.parametrize(
    ("port", "variable", "slopes"),
    [
        ("cart", "cart_position", 1),
        ("cart", "cart_velocity", 1),
        ("arm", "arm_velocity", 2),
        ("arm", "cart_position", 0),
        ("cart", "arm_velocity", 0),
    ],
)
def test_what_a_parameter_of_the_model_has_is_left_to_it(port: str, variable: str, slopes: int) -> None:
    at = np.linspace(-2.0, 3.0, 12)
    random = np.random.default_rng(3)
    shapes = random.standard_normal((6, 12)) + 4.0 * at
    curve = ForceCurve(port, variable, 1.0, at, at, np.ones(12), 1.0, 1.0, 0.0, shapes, np.ones(6))
    effect = curve.effect()
    used = effect.used
    kept = np.array([[float(height) for height in shape] for shape in effect.shapes[:used]])
    basis = np.column_stack([*((np.maximum(at, 0), np.minimum(at, 0)) if slopes == 2 else (at,)), np.ones(12)])
    found = np.linalg.lstsq(basis, kept.T, rcond=None)[0][:-1]
    if slopes:
        assert np.max(np.abs(found)) < 1e-12
        assert np.linalg.cond(kept / np.max(np.abs(kept), axis=1, keepdims=True)) < 10.0
    else:
        assert np.min(np.abs(found)) > 0.1
    amounts = np.array([float(getattr(effect, f"amount_{n}")) for n in range(1, used + 1)])
    left = np.ones(6) @ shapes - amounts @ kept  # but for the slopes, little
    beside = left - basis[:, :-1] @ np.linalg.lstsq(basis, left, rcond=None)[0][:-1]
    assert np.std(beside) < 0.3 * np.std(amounts @ kept)
