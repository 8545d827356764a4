"""A fitted effect as a curve over the missing force that it explains."""

import dataclasses

import numpy as np
import pytest
from made_up_results import CURVES

from estimators.misspecification.static_force import ForceCurve
from estimators.plots.effect_curve import effect_curve
from rtac_jax.effects import CartStribeck, Cogging, CubicSpring, Effect, FlexibleMode, GravityTilt


def test_a_fitted_static_force_lies_on_the_curve_that_it_made():
    """The curve of a cubic spring without the slope that the linear spring takes up, however much that is."""
    at = np.linspace(-0.012, 0.012, 12)
    for slope in (0.0, 3.0):
        shown = dataclasses.replace(CURVES[0], at=at, force=-29_000.0 * at**3 + slope * at, std=np.full(12, 1e-3))
        found = effect_curve(CubicSpring(29_000.0), shown)
        assert found is not None
        np.testing.assert_allclose(np.interp(at, *found), shown.force, atol=2e-4)


def test_dry_friction_has_a_sign():
    speeds = np.linspace(-0.1, 0.1, 12)
    level = 0.05 * np.exp(-((speeds / 0.02) ** 2))
    shown = dataclasses.replace(CURVES[1], at=speeds, force=-level * np.sign(speeds), std=np.full(12, 1e-3))
    found = effect_curve(CartStribeck(0.05, 0.02), shown)
    assert found is not None
    np.testing.assert_allclose(found[1][found[0] > 0.05], 0.0, atol=2e-3)
    assert found[1][found[0] < 0].max() > 0.02 > -0.02 > found[1][found[0] > 0].min()


@pytest.mark.parametrize(
    ("effect", "curve"),
    [
        (Cogging(1e-3, 0.0, 3.0), CURVES[0]),  # depends on the arm's angle, not on this variable
        (CubicSpring(1e4), CURVES[1]),
        (CubicSpring(1e4), CURVES[3]),  # on the other port
        (FlexibleMode(0.1, 37.4, 0.03), CURVES[0]),  # has states of its own
        (GravityTilt(0.01, 0.01), CURVES[0]),  # needs the mass of the body
    ],
)
def test_only_a_static_force_in_the_variable_is_drawn(effect: Effect, curve: ForceCurve):
    assert effect_curve(effect, curve) is None
