"""Bounds by reparametrisation: unconstrained numbers of order one in place of physical parameters."""

from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import expit

Vector = Float[Array | np.ndarray, "..."]


def to_physical(z: Vector, lower: Vector, upper: Vector, scale: Vector) -> Any:
    """Return physical values from unconstrained ones; NumPy's where all numbers are NumPy's.

    Without bounds scale * z; with one bound the bound plus scale * (z + sqrt(z^2 + 4)) / 2, which is linear far from
    the bound and reaches it only at infinity; with two a logistic curve between them. JAX's derivatives are those by z: bounds and
    scale are numbers.
    """
    if all(isinstance(x, np.ndarray) for x in (z, lower, upper, scale)):
        with np.errstate(over="ignore", invalid="ignore"):  # far beyond all bounds, as compiled code does
            return _value_and_slope(z, lower, upper, scale, xp=np)[0]
    return _traced(z, lower, upper, scale)


def slopes(z: Vector, lower: Vector, upper: Vector, scale: Vector) -> np.ndarray:
    """Return the derivatives of the physical values by the unconstrained ones, exact however close to a bound."""
    with np.errstate(over="ignore", invalid="ignore"):
        return _value_and_slope(*(np.asarray(x, dtype=float) for x in (z, lower, upper, scale)), xp=np)[1]


@jax.custom_jvp
def _traced(z: Array, lower: Array, upper: Array, scale: Array) -> Array:
    return _value_and_slope(z, lower, upper, scale, xp=jnp)[0]


@_traced.defjvp
def _traced_jvp(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Array, Array]:
    # Of the steps one by one JAX would make ten times as many operations, in every program that knows derivatives.
    z, lower, upper, scale = primals
    value, slope = _value_and_slope(z, lower, upper, scale, xp=jnp)
    return value, slope * tangents[0]


def _value_and_slope(z: Vector, lower: Vector, upper: Vector, scale: Vector, *, xp: ModuleType) -> tuple[Any, Any]:
    """Return what `to_physical` does and its derivative, without cancellation, so that neither is lost close to a bound."""
    sigmoid = expit if xp is np else jax.nn.sigmoid
    low, high = xp.isfinite(lower), xp.isfinite(upper)
    # Away from the one bound that there is: a curve that is linear far from it.
    side = xp.where(low, 1.0, -1.0)
    t = side * z
    root = xp.sqrt(t * t + 4.0)
    away = xp.where(t < 0, 2.0 / (root + xp.abs(t)), 0.5 * (root + xp.abs(t)))
    first, last = xp.where(low, lower, 0.0), xp.where(high, upper, 0.0)
    fraction = sigmoid(z)
    both, one = low & high, low | high
    value = xp.where(
        both,
        first + (last - first) * fraction,
        xp.where(one, xp.where(low, first, last) + side * scale * away, scale * z),
    )
    return value, xp.where(both, (last - first) * fraction * sigmoid(-z), xp.where(one, scale * away / root, scale))


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
