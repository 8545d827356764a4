"""Frequency response and transient from neighbouring lines of a spectrum: local polynomials and local fractions."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.stats
from jaxtyping import Bool, Complex128, Float64, Int, Real

# Two take off the bias by noise; more would let a pole chase the noise of single lines where the data show none.
REFINEMENTS = 2
NOTHING = 1e-9  # of the largest line, below which an input is rounding
_RINGING_POLES = 2  # of one lightly damped mode
# At which a fraction explains more of a transient than a polynomial does: by chance at one line in a thousand.
_RINGING_LEVEL = 1e-3


class VanishingError(ValueError):
    """An input that cannot show the response around a line; `line` is its place in the spectrum."""

    def __init__(self, line: float) -> None:
        super().__init__(f"the excitation vanishes around line {line:g} of the spectrum; excite it or leave it out.")
        self.line = line


class LocalFit(NamedTuple):
    """The estimates from the lines around each line.

    Attributes:
        response: [unit of output / unit of input].
        std: root of the mean squared magnitude of the response's error.
        noise: root of the mean squared magnitude of what is left at one line [unit of output].
        freedom: complex degrees of freedom of `noise`.
    """

    response: Complex128[np.ndarray, "_line"]
    std: Float64[np.ndarray, "_line"]
    noise: Float64[np.ndarray, "_line"]
    freedom: int


def local_response(
    into: Complex128[np.ndarray, " bin"],
    out: Complex128[np.ndarray, " bin"],
    lines: Real[np.ndarray, " line"],
    *,
    half_width: int,
    degree: int = 2,
    poles: int = 2,
) -> LocalFit:
    """Estimate the response at some lines of two spectra, with transients and leakage as a smooth part of their own.

    Around each line, with r the distance from it in half widths,

        Y (1 + d_1 r + ...) = (g_0 + g_1 r + ...) U + t_0 + t_1 r + ...

    is fitted over `2 half_width + 1` lines, and g_0 is the response. Without `poles` this is the local polynomial method
    and linear; with them, a resonance that is as narrow as the window is followed as well, and the linear solution is
    refined by two Gauss-Newton steps on the residual of Y itself.

    Args:
        into: discrete Fourier transform of the input, from zero frequency on.
        out: discrete Fourier transform of the output.
        lines: numbers of the lines asked for; places between lines are allowed.
        half_width: lines to each side; near the ends of the spectrum the window is moved.
        degree: of the polynomials g and t.
        poles: degree of the polynomial d.

    Raises:
        ValueError: the window is too small for the unknowns or too large for the spectrum.
        VanishingError: the input around a line vanishes, or has too few lines to tell response from transient.

    Source: Schoukens, Vandersteen, Barbe and Pintelon (2009), and for the fractions McKelvey and Guerin (2012).
    """
    into_near, target, distance = windows_of(into, out, lines, half_width=half_width, degree=degree, poles=poles)
    width, unknowns = target.shape[1], 2 * (degree + 1) + poles
    powers = distance[:, :, None] ** np.arange(max(degree, poles) + 1)
    regressors = np.concatenate(
        [
            powers[:, :, : degree + 1] * into_near[:, :, None],
            powers[:, :, : degree + 1].astype(np.complex128),
            -powers[:, :, 1 : poles + 1] * target[:, :, None],
        ],
        axis=2,
    )
    scale = np.sqrt(np.mean(np.abs(regressors) ** 2, axis=1, keepdims=True))
    refuse_vanishing(lines, scale[:, 0, 0] <= NOTHING * np.max(np.abs(into[1:]), initial=0.0))
    regressors /= np.where(scale > 0, scale, 1.0)
    upper = np.linalg.qr(regressors, mode="r")
    diagonal = np.abs(np.diagonal(upper, axis1=1, axis2=2))
    refuse_vanishing(lines, diagonal[:, : degree + 1].min(axis=1) < NOTHING * diagonal.max(axis=1))
    solution, first_row, left = _least_squares(regressors, target)
    if poles:
        # With noise on the output that equation has noise among its regressors, so the fraction itself is fitted next.
        solution, first_row, left = _refined(
            solution / scale[:, 0], target, regressors, scale, powers[:, :, 1 : poles + 1], 2 * (degree + 1)
        )
    solution, first_row = solution[:, 0] / scale[:, 0, 0], first_row / scale[:, 0, 0]
    freedom = width - unknowns
    noise = np.sqrt(np.sum(np.abs(left) ** 2, axis=1) / freedom)
    return LocalFit(solution, noise * first_row, noise, freedom)


# Axes without a name that counts: several spectra have each their own lengths.
Spectra = tuple[Complex128[np.ndarray, "_bin"], Complex128[np.ndarray, "_bin"], Real[np.ndarray, "_line"]]
"""Discrete Fourier transforms of an input and an output, and the lines asked for."""


def one_by_one(
    spectra: Sequence[Spectra], *, half_width: int, degree: int = 2, poles: int = 2
) -> list[LocalFit | VanishingError]:
    """Return `local_response` of several spectra, or its error where an input vanishes."""
    found: list[LocalFit | VanishingError] = []
    for into, out, lines in spectra:
        try:
            found.append(local_response(into, out, lines, half_width=half_width, degree=degree, poles=poles))
        except VanishingError as error:
            found.append(error)
    return found


class Windows(NamedTuple):
    """Two spectra around each line."""

    into: Complex128[np.ndarray, "line neighbour"]
    out: Complex128[np.ndarray, "line neighbour"]
    distance: Float64[np.ndarray, "line neighbour"]  # of the neighbours from the line, in half widths


def windows_of(
    into: Complex128[np.ndarray, " bin"],
    out: Complex128[np.ndarray, " bin"],
    lines: Real[np.ndarray, " line"],
    *,
    half_width: int,
    degree: int,
    poles: int,
) -> Windows:
    """Cut the lines beside each line out of two spectra; arguments and errors are those of `local_response`."""
    width = 2 * half_width + 1
    unknowns = 2 * (degree + 1) + poles
    if width <= unknowns:
        raise ValueError(
            f"half_width: {half_width} lines to each side give {width} equations for {unknowns} unknowns; use at least "
            f"{unknowns // 2 + 1}."
        )
    if width > len(out) - 1:
        raise ValueError(
            f"half_width: a window of {width} lines does not fit into a spectrum of {len(out)}; record for longer."
        )
    # Zero frequency holds the offset of the sensor, and no window contains it.
    first = np.clip(np.rint(lines).astype(np.int64) - half_width, 1, len(out) - width)
    window = first[:, None] + np.arange(width)
    return Windows(into[window], out[window], (window - lines[:, None]) / half_width)


def refuse_vanishing(lines: Real[np.ndarray, " line"], vanishes: Bool[np.ndarray, " line"]) -> None:
    """Refuse lines around which the input shows no response.

    Raises:
        VanishingError: names the first of them.
    """
    if vanishes.any():
        raise VanishingError(float(lines[np.argmax(vanishes)]))


def _least_squares(matrix: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solve many problems [problem, equation, unknown]: solutions, root of the first unknown's variance, and residuals."""
    orthogonal, upper = np.linalg.qr(matrix)
    projected = np.einsum("fwp,fw->fp", orthogonal.conj(), target)
    inverse = np.linalg.inv(upper)
    left = target - np.einsum("fwp,fp->fw", orthogonal, projected)
    return np.einsum("fpq,fq->fp", inverse, projected), np.sqrt(np.sum(np.abs(inverse[:, 0]) ** 2, axis=1)), left


def _refined(
    unknowns: np.ndarray, target: np.ndarray, regressors: np.ndarray, scale: np.ndarray, powers: np.ndarray, linear: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Refine Y = (g U + t) / (1 + d) by Gauss-Newton: scaled unknowns, root of the first one's variance, and residuals.

    A step that does not lower the residual of its line is not taken there.
    """
    scaled = unknowns * scale[:, 0]
    top, size = regressors[:, :, :linear], scale[:, 0, linear:]

    def model(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        below = 1.0 + np.einsum("fwp,fp->fw", powers, x[:, linear:] / size)
        return np.einsum("fwp,fp->fw", top, x[:, :linear]) / below, below

    def jacobian(value: np.ndarray, below: np.ndarray) -> np.ndarray:
        by_poles = -powers * (value / below)[:, :, None] / size[:, None, :]
        return np.concatenate([top / below[:, :, None], by_poles], axis=2)

    value, below = model(scaled)
    for _ in range(REFINEMENTS):
        step, _, _ = _least_squares(jacobian(value, below), target - value)
        moved = scaled + step
        fresh, fresh_below = model(moved)
        better = np.sum(np.abs(target - fresh) ** 2, axis=1) < np.sum(np.abs(target - value) ** 2, axis=1)
        scaled = np.where(better[:, None], moved, scaled)
        value, below = np.where(better[:, None], fresh, value), np.where(better[:, None], fresh_below, below)
        if not better.any():
            break
    _, first_row, _ = _least_squares(jacobian(value, below), target - value)
    return scaled, first_row, target - value


class Transient(NamedTuple):
    """The smooth part at some lines, by the lines beside them, and the residuals of these.

    Attributes:
        smooth: at the line itself.
        left: at the lines beside it.
        factor: variance at the line after the smooth part is taken off, over that of one line.
        freedom: complex degrees of freedom of `left`.
    """

    smooth: Complex128[np.ndarray, " line"]
    left: Complex128[np.ndarray, "line neighbour"]
    factor: Float64[np.ndarray, " line"]
    freedom: int


def local_transient(
    out: Complex128[np.ndarray, " bin"],
    lines: Int[np.ndarray, " line"],
    *,
    periods: int,
    neighbours: int,
    degree: int = 2,
) -> Transient:
    """Estimate transient and noise at harmonics of a record of whole periods, from the lines between the harmonics.

    A periodic steady state has only every `periods`-th line, so what lies between is transient, which is smooth, and
    noise, which is not (Pintelon and Schoukens 2012, section 7.3). A transient that rings on beyond the record is a peak as narrow
    as a line, which no polynomial follows: a fraction with two poles stands for it where it leaves so much less that chance does so
    at one line in a thousand.

    Raises:
        ValueError: fewer neighbours than the polynomial has unknowns, or than the spectrum has lines.
    """
    if neighbours <= degree + 1:
        raise ValueError(
            f"neighbours: {neighbours} lines leave nothing for noise beside a polynomial of degree {degree}; use more."
        )
    between = np.arange(1, len(out))
    between = between[between % periods != 0]
    if len(between) < neighbours:
        raise ValueError(f"neighbours: there are only {len(between)} lines between the harmonics; record more periods.")
    middle = np.searchsorted(between, lines)
    window = between[np.clip(middle - neighbours // 2, 0, len(between) - neighbours)[:, None] + np.arange(neighbours)]
    distance = (window - lines[:, None]) / (neighbours * periods / (periods - 1))
    orthogonal, upper = np.linalg.qr(distance[:, :, None] ** np.arange(degree + 1))
    values = out[window]
    projected = np.einsum("fwp,fw->fp", orthogonal, values)
    at_line = np.linalg.inv(upper)[:, 0]  # the polynomial at distance zero is its constant
    left = values - np.einsum("fwp,fp->fw", orthogonal, projected)
    factor = 1.0 + np.sum(at_line**2, axis=1)
    found = Transient(np.einsum("fp,fp->f", at_line, projected), left, factor, neighbours - degree - 1)
    return _ringing(found, values, distance, degree)


def _ringing(
    smooth: Transient,
    values: Complex128[np.ndarray, "line neighbour"],
    distance: Float64[np.ndarray, "line neighbour"],
    degree: int,
) -> Transient:
    """Return the transient with a fraction in place of the polynomial at those lines where that explains more than chance.

    Its residuals are scaled to the freedom of the polynomial's.
    """
    freedom = smooth.freedom - _RINGING_POLES
    if freedom < _RINGING_POLES:
        return smooth
    powers = distance[:, :, None] ** np.arange(max(degree, _RINGING_POLES) + 1)
    below = powers[:, :, 1 : _RINGING_POLES + 1]
    regressors = np.concatenate([powers[:, :, : degree + 1].astype(np.complex128), -below * values[:, :, None]], axis=2)
    scale = np.sqrt(np.mean(np.abs(regressors) ** 2, axis=1, keepdims=True))
    scale = np.where(scale > 0, scale, 1.0)
    regressors = regressors / scale
    upper = np.abs(np.diagonal(np.linalg.qr(regressors, mode="r"), axis1=1, axis2=2))
    sound = upper.min(axis=1) > NOTHING * upper.max(axis=1)
    found = smooth._replace(left=smooth.left.copy(), smooth=smooth.smooth.copy(), factor=smooth.factor.copy())
    if not sound.any():
        return found
    part = (regressors[sound], values[sound])
    begun = _least_squares(*part)[0]
    solution, first_row, left = _refined(
        begun / scale[sound, 0], part[1], part[0], scale[sound], below[sound], degree + 1
    )
    before, after = (np.sum(np.abs(x) ** 2, axis=1) for x in (smooth.left[sound], left))
    least = 1.0 + _RINGING_POLES / freedom * float(scipy.stats.f.isf(_RINGING_LEVEL, 2 * _RINGING_POLES, 2 * freedom))
    rings = before > least * after
    places = np.flatnonzero(sound)[rings]
    size = scale[places, 0, 0]
    found.smooth[places] = solution[rings, 0] / size
    found.factor[places] = 1.0 + (first_row[rings] / size) ** 2
    found.left[places] = left[rings] * np.sqrt(smooth.freedom / freedom)
    return found
