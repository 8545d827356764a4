"""Sine and cosine that a compiler can vectorise: XLA's own on a CPU call a scalar routine for every element."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

# Coefficients of the minimax polynomials of fdlibm (k_sin.c, k_cos.c) on [-pi/4, pi/4].
_S = (
    -1.66666666666666324348e-01,
    8.33333333332248946124e-03,
    -1.98412698298579493134e-04,
    2.75573137070700676789e-06,
    -2.50507602534068634195e-08,
    1.58969099521155010221e-10,
)
_C = (
    4.16666666666666019037e-02,
    -1.38888888888741095749e-03,
    2.48015872894767294178e-05,
    -2.75573143513906633035e-07,
    2.08757232129817482790e-09,
    -1.13596475577881948265e-11,
)
# pi/2 in three parts (Cody and Waite), exact for angles up to about 1e5 rad.
_PIO2 = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21)


def sincos(angle: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Return sine and cosine of an angle [rad], exact to 1e-16 up to about 1e5 rad.

    Source: range reduction of Cody and Waite, minimax polynomials of fdlibm.
    """
    return _once(angle)


@jax.custom_jvp
def _sincos(angle: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    turns = jnp.round(angle * (2.0 / jnp.pi))
    x = angle
    for part in _PIO2:
        x = x - turns * part
    z = x * x
    s, c = _S[-1], _C[-1]
    for a, b in zip(_S[-2::-1], _C[-2::-1], strict=True):
        s, c = s * z + a, c * z + b
    sine = x + x * z * s
    cosine = 1.0 - 0.5 * z + z * z * c
    quadrant = turns - 4.0 * jnp.floor(0.25 * turns)
    odd = (quadrant == 1.0) | (quadrant == 3.0)
    sin_sign = jnp.where(quadrant >= 2.0, -1.0, 1.0)
    cos_sign = jnp.where((quadrant == 1.0) | (quadrant == 2.0), -1.0, 1.0)
    return sin_sign * jnp.where(odd, cosine, sine), cos_sign * jnp.where(odd, sine, cosine)


@_sincos.defjvp
def _sincos_jvp(primals: tuple, tangents: tuple) -> tuple:
    (angle,), (tangent,) = primals, tangents
    s, c = _sincos(angle)
    return (s, c), (c * tangent, -s * tangent)


# By itself it is traced once within a program, and not wherever an effect asks for it.
_once = jax.jit(_sincos)
