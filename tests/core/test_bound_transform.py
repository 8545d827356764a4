"""The unconstrained stand-ins of bounded parameters."""

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
