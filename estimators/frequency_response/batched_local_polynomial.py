"""Local fits of all conditions in one vmapped, compiled program."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from estimators.frequency_response.local_polynomial import (
    NOTHING,
    REFINEMENTS,
    LocalFit,
    Spectra,
    VanishingError,
    Windows,
    refuse_vanishing,
    windows_of,
)
from rtac_jax import require_configured
from rtac_jax.programs import program

_CHUNK = 128  # windows side by side, which the second-level cache of a core holds; the fastest of 32 to 1024

Column = Complex[Array, " neighbour"]


def local_responses(
    spectra: Sequence[Spectra], *, half_width: int, degree: int = 2, poles: int = 2
) -> list[LocalFit | VanishingError]:
    """Estimate what `local_response` does, for the spectra of many conditions at once and to rounding.

    The windows of all conditions stand in one batch that is filled up to a power of two of chunks, so that records of any
    length and number share a program. The factorisation is written out: it is faster so, and a large batch in LAPACK makes
    the threads of jaxlib wait for each other (docs/decisions/threads_and_lapack.md).

    Args:
        spectra: of each condition the discrete Fourier transforms of input and output, and the lines asked for.
        half_width: as in `local_response`.
        degree: as in `local_response`.
        poles: as in `local_response`.

    Returns:
        One fit for each condition, or its error where its input vanishes.

    Raises:
        ValueError: as `local_response`.
        RuntimeError: JAX was not configured for double precision.
    """
    require_configured()
    cut = [windows_of(*one, half_width=half_width, degree=degree, poles=poles) for one in spectra]
    counts = [len(one.out) for one in cut]
    total = sum(counts)
    chunks = 1 << max(0, int(np.ceil(np.log2(total / _CHUNK))))

    def laid_out(parts: Sequence[np.ndarray]) -> np.ndarray:
        """Return [chunk, neighbour, window]; the last window fills what is left."""
        rows = np.concatenate(parts)
        filled = np.concatenate([rows, np.repeat(rows[-1:], chunks * _CHUNK - total, axis=0)])
        return np.ascontiguousarray(np.moveaxis(filled.reshape(chunks, _CHUNK, -1), 1, 2))

    batch = [jnp.asarray(laid_out(parts)) for parts in zip(*cut, strict=True)]
    found = [np.asarray(part).reshape(-1)[:total] for part in _all_windows(*batch, degree=degree, poles=poles)]
    freedom = 2 * half_width + 1 - 2 * (degree + 1) - poles
    fits: list[LocalFit | VanishingError] = []
    for number, end in enumerate(np.cumsum(counts)):
        response, std, noise, size, weakest = (part[end - counts[number] : end] for part in found)
        into, _, lines = spectra[number]
        try:
            refuse_vanishing(lines, size <= NOTHING * np.max(np.abs(into[1:]), initial=0.0))
            refuse_vanishing(lines, ~(weakest >= NOTHING))
            fits.append(LocalFit(response, std, noise, freedom))
        except VanishingError as error:
            fits.append(error)
    return fits


@program
def _all_windows(into: Array, out: Array, distance: Array, *, degree: int, poles: int) -> tuple[Array, ...]:
    """Fit all windows, [chunk, neighbour, window]; returns response, std, noise, size of the input, weakest diagonal."""
    each = jax.vmap(partial(_one_window, degree=degree, poles=poles), in_axes=-1, out_axes=-1)
    return jax.lax.map(lambda chunk: each(Windows(*chunk)), (into, out, distance))


def _one_window(near: Any, *, degree: int, poles: int) -> tuple[Array, ...]:
    """Do the arithmetic of `local_response` in one window."""
    powers = near.distance ** jnp.arange(max(degree, poles) + 1)[:, None]
    regressors = jnp.concatenate(
        [powers[: degree + 1] * near.into, powers[: degree + 1] + 0j, -powers[1 : poles + 1] * near.out]
    )
    scale = jnp.sqrt(jnp.mean(_squared(regressors), axis=1))
    divisor = jnp.where(scale > 0, scale, 1.0)
    regressors = regressors / divisor[:, None]
    solution, first_row, left, diagonal = _least_squares(regressors, near.out)
    weakest = jnp.min(diagonal[: degree + 1]) / jnp.max(diagonal)
    if poles:
        linear = 2 * (degree + 1)
        top, below_by = regressors[:linear], powers[1 : poles + 1] / divisor[linear:, None]

        def model(x: Array) -> tuple[Array, Array]:
            below = 1.0 + jnp.sum(below_by * x[linear:, None], axis=0)
            return jnp.sum(top * x[:linear, None], axis=0) / below, below

        def jacobian(value: Column, below: Column) -> Array:
            return jnp.concatenate([top / below, -below_by * (value / below)])

        value, below = model(solution)
        for _ in range(REFINEMENTS):
            moved = solution + _least_squares(jacobian(value, below), near.out - value)[0]
            fresh, fresh_below = model(moved)
            better = jnp.sum(_squared(near.out - fresh)) < jnp.sum(_squared(near.out - value))
            solution = jnp.where(better, moved, solution)
            value, below = jnp.where(better, fresh, value), jnp.where(better, fresh_below, below)
        _, first_row, _, _ = _least_squares(jacobian(value, below), near.out - value)
        left = near.out - value
    noise = jnp.sqrt(jnp.sum(_squared(left)) / (len(left) - len(regressors)))
    return solution[0] / scale[0], noise * first_row / scale[0], noise, scale[0], weakest


def _squared(values: Array) -> Array:
    return values.real**2 + values.imag**2


def _least_squares(
    columns: Complex[Array, "unknown neighbour"], target: Column
) -> tuple[Complex[Array, " unknown"], Float[Array, ""], Column, Float[Array, " unknown"]]:
    """Solve one problem by modified Gram-Schmidt, the target as its last column.

    Backward stable for least squares (Bjorck, Numerical Methods for Least Squares Problems, 1996, section 2.4.4). Real and
    imaginary parts stand apart, as complex numbers side by side do not fill the machine's vectors.

    Returns:
        Solution, root of the first unknown's variance, residuals, and the diagonal of the triangle.
    """
    count = len(columns)
    real, imaginary = (part(jnp.concatenate([columns, target[None]])) for part in (jnp.real, jnp.imag))
    numbers = jnp.arange(count + 1)

    def orthogonalised(i: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
        real, imaginary, upper_real, upper_imaginary = state
        a, b = real[i], imaginary[i]
        size = jnp.sqrt(jnp.sum(a * a + b * b))
        a, b = a / size, b / size
        later = numbers > i
        along = jnp.where(later, jnp.sum(a * real + b * imaginary, axis=1), 0.0)
        across = jnp.where(later, jnp.sum(a * imaginary - b * real, axis=1), 0.0)
        real = real - (along[:, None] * a - across[:, None] * b)
        imaginary = imaginary - (along[:, None] * b + across[:, None] * a)
        row = along + jnp.where(numbers == i, size, 0.0)
        return real, imaginary, upper_real.at[i].set(row), upper_imaginary.at[i].set(across)

    nothing = jnp.zeros((count, count + 1))
    real, imaginary, upper_real, upper_imaginary = jax.lax.fori_loop(
        0, count, orthogonalised, (real, imaginary, nothing, nothing)
    )
    triangle, diagonal = upper_real + 1j * upper_imaginary, jnp.diagonal(upper_real)

    def solved(k: Array, x: Array) -> Array:
        i = count - 1 - k
        return x.at[i].set((triangle[i, count] - jnp.sum(triangle[i, :count] * x)) / diagonal[i])

    def inverted(j: Array, row: Array) -> Array:
        return row.at[j].set(((j == 0) - jnp.sum(triangle[:, j] * row)) / diagonal[j])

    empty = jnp.zeros(count, triangle.dtype)
    solution = jax.lax.fori_loop(0, count, solved, empty)
    first_row = jax.lax.fori_loop(0, count, inverted, empty)  # of the inverse of the triangle
    left = real[count] + 1j * imaginary[count]
    return solution, jnp.sqrt(jnp.sum(_squared(first_row))), left, diagonal
