"""Bounds by reparametrisation: unconstrained numbers of order one in place of physical parameters."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Vector = Float[Array, "..."]


def to_physical(z: Vector, lower: Vector, upper: Vector, scale: Vector) -> Vector:
    """Return physical values from unconstrained ones.

    Without bounds scale * z; with one bound the bound plus scale * (z + sqrt(z^2 + 4)) / 2, which is linear far from
    the bound and reaches it only at infinity; with two a logistic curve between them.
    """
    # The sum and its slope are formed without cancellation, so that neither is lost close to the bound.
    root = jnp.sqrt(z * z + 4.0)
    far, near = 0.5 * (root + jnp.abs(z)), 2.0 / (root + jnp.abs(z))
    positive, negative = jnp.where(z < 0, near, far), jnp.where(z < 0, far, near)
    low, high = jnp.isfinite(lower), jnp.isfinite(upper)
    finite_low, finite_high = jnp.where(low, lower, 0.0), jnp.where(high, upper, 0.0)
    between = finite_low + (finite_high - finite_low) * jax.nn.sigmoid(z)
    one_sided = jnp.where(low, finite_low + scale * positive, finite_high - scale * negative)
    return jnp.where(low & high, between, jnp.where(low | high, one_sided, scale * z))


def to_unconstrained(
    value: np.ndarray, lower: np.ndarray, upper: np.ndarray, scale: np.ndarray, *, inside: float = 1e-3
) -> np.ndarray:
    """Invert `to_physical`; a value on its bound is moved inside by this fraction of the scale."""
    value, lower, upper, scale = np.broadcast_arrays(
        *(np.asarray(x, dtype=float) for x in (value, lower, upper, scale))
    )
    low, high = np.isfinite(lower), np.isfinite(upper)
    with np.errstate(all="ignore"):
        above = np.maximum((value - lower) / scale, inside)
        below = np.maximum((upper - value) / scale, inside)
        fraction = np.clip((value - lower) / (upper - lower), inside, 1 - inside)
        return np.select(
            [low & high, low, high],
            [np.log(fraction / (1 - fraction)), above - 1 / above, 1 / below - below],
            value / scale,
        )


def slopes(z: np.ndarray, lower: np.ndarray, upper: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return the derivatives of the physical values by the unconstrained ones, exact however close to a bound."""
    z, lower, upper, scale = np.broadcast_arrays(*(np.asarray(x, dtype=float) for x in (z, lower, upper, scale)))
    low, high = np.isfinite(lower), np.isfinite(upper)
    size = np.abs(z)
    root = np.sqrt(z * z + 4.0)
    falling = 2.0 / (root * (root + size))  # of the part that goes to the bound
    toward = np.where(low, z < 0, z > 0)
    one_sided = scale * np.where(toward, falling, 1.0 - falling)
    tail = np.exp(-size)
    width = np.where(low & high, upper, 0.0) - np.where(low & high, lower, 0.0)
    return np.where(low & high, width * tail / (1.0 + tail) ** 2, np.where(low | high, one_sided, scale))
