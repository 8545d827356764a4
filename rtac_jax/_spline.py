"""The cubic spline through equidistant samples, by operations that JAX can trace and differentiate."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

FEWEST = 4  # samples that determine a cubic


def spline_coefficients(values: Float[Array, " sample"]) -> Float[Array, "sample power"]:
    """Return rising powers of the fraction of the interval after each sample; the last interval holds its value.

    Source: de Boor, A Practical Guide to Splines (2001), chapter IV: not-a-knot ends, as in SciPy's `CubicSpline`.
    """
    rise = jnp.diff(values)
    ones = jnp.ones_like(values[2:])
    one, two, none = (jnp.full_like(values[:1], x) for x in (1.0, 2.0, 0.0))
    right = jnp.concatenate(
        [
            0.5 * (5.0 * rise[:1] + rise[1:2]),
            3.0 * (rise[:-1] + rise[1:]),
            0.5 * (rise[-2:-1] + 5.0 * rise[-1:]),
        ]
    )
    below = jnp.concatenate([none, ones, two])
    middle = jnp.concatenate([one, 4.0 * ones, one])
    above = jnp.concatenate([two, ones, none])
    slope = jax.lax.linalg.tridiagonal_solve(below, middle, above, right[:, None])[:, 0]
    here, there = slope[:-1], slope[1:]
    intervals = jnp.stack([values[:-1], here, 3.0 * rise - 2.0 * here - there, here + there - 2.0 * rise], axis=1)
    last = jnp.zeros((1, 4), values.dtype).at[0, 0].set(values[-1])
    return jnp.concatenate([intervals, last])
