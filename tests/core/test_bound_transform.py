"""The unconstrained stand-ins of bounded parameters."""

import jax
import jax.numpy as jnp
import numpy as np

from estimators.core.bound_transform import to_physical, to_unconstrained


def test_transform_is_invertible_and_keeps_bounds() -> None:
    infinity = np.inf
    lower = np.array([-infinity, 0.0, 0.0, -infinity, 2.0])
    upper = np.array([infinity, infinity, 1.0, 3.0, infinity])
    scale = np.array([5.0, 0.1, 1.0, 2.0, 1e-6])
    value = np.array([-7.0, 0.03, 0.3, -4.0, 2.0 + 3e-6])
    z = to_unconstrained(value, lower, upper, scale)
    np.testing.assert_allclose(to_physical(*map(jnp.asarray, (z, lower, upper, scale))), value, rtol=1e-12)
    for extreme in (-50.0, 50.0):
        moved = np.asarray(to_physical(jnp.full(5, extreme), *map(jnp.asarray, (lower, upper, scale))))
        assert np.all(moved >= lower)
        assert np.all(moved <= upper)


def test_known_numbers_and_traced_ones_are_transformed_alike() -> None:
    z = np.array([-40.0, -3.0, 0.0, 2.0, 30.0])
    for low, high in ((0.0, np.inf), (-np.inf, 1.0), (0.2, 1.0), (-np.inf, np.inf)):
        given = (z, *(np.full(len(z), x) for x in (low, high, 2.0)))
        known, traced = to_physical(*given), to_physical(*map(jnp.asarray, given))
        assert isinstance(known, np.ndarray)
        np.testing.assert_allclose(known, traced, rtol=1e-14)
        far = (np.array([1e200]), *(x[:1] for x in given[1:]))  # which overflows, and is no error
        np.testing.assert_array_equal(to_physical(*far), to_physical(*map(jnp.asarray, far)))


def test_the_curvature_below_a_bound_is_that_above_it_turned_round() -> None:
    def bend(z: float, low: float, high: float) -> float:
        return float(jax.grad(jax.grad(to_physical))(*map(jnp.asarray, (z, low, high, 2.0))))

    for z in (-1.0, 0.0, 1.0):
        assert bend(z, -np.inf, 1.0) == -bend(-z, 0.0, np.inf) < 0
