"""Bounds by reparametrisation: unconstrained numbers of order one in place of physical parameters."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Vector = Float[Array, "..."]


@jax.custom_jvp
def to_physical(z: Vector, lower: Vector, upper: Vector, scale: Vector) -> Vector:
    """Return physical values from unconstrained ones.

    Without bounds scale * z; with one bound the bound plus scale * (z + sqrt(z^2 + 4)) / 2, which is linear far from
    the bound and reaches it only at infinity; with two a logistic curve between them. Derivatives are those by z: bounds
    and scale are numbers.
    """
    return _value_and_slope(z, lower, upper, scale)[0]


@to_physical.defjvp
def _to_physical_jvp(primals: tuple[Vector, ...], tangents: tuple[Vector, ...]) -> tuple[Vector, Vector]:
    # Of the steps one by one JAX would make ten times as many operations, in every program that knows derivatives.
    value, slope = _value_and_slope(*primals)
    return value, slope * tangents[0]


def _value_and_slope(z: Vector, lower: Vector, upper: Vector, scale: Vector) -> tuple[Vector, Vector]:
    # Both are formed without cancellation, so that neither is lost close to the bound.
    root = jnp.sqrt(z * z + 4.0)
    far, near = 0.5 * (root + jnp.abs(z)), 2.0 / (root + jnp.abs(z))
    low, high = jnp.isfinite(lower), jnp.isfinite(upper)
    # Of z, or of -z below an upper bound: the curve that is linear far from the bound.
    side = jnp.where(low, 1.0, -1.0)
    away = jnp.where(side * z < 0, near, far)
    first, last = jnp.where(low, lower, 0.0), jnp.where(high, upper, 0.0)
    fraction = jax.nn.sigmoid(z)
    both, one = low & high, low | high
    value = jnp.where(
        both,
        first + (last - first) * fraction,
        jnp.where(one, jnp.where(low, first, last) + side * scale * away, scale * z),
    )
    slope = jnp.where(both, (last - first) * fraction * jax.nn.sigmoid(-z), jnp.where(one, scale * away / root, scale))
    return value, slope


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
