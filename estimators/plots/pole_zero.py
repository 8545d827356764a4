"""Poles and zeros of a fitted model in the complex plane, with ellipses of two standard deviations."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from estimators.core.fit import Fit
from estimators.core.parameter_correlation import ellipse
from estimators.inference.model_response import Roots, model_roots
from estimators.linear.fit import LinearModels
from estimators.plots.style import SMALL, Picture, picture, tidy, title
from estimators.prediction_error.fit import PredictorFit

_MOST = 60  # conditions
_POLE, _ZERO = "#08306b", "#e6550d"
# Of the spread of poles and zeros: an ellipse that is not seen, and up to which it is enlarged.
_SMALL, _SHOWN = 0.02, 0.12
_CLOSE = 4  # modes and pairs of zeros that are shown from near by, with axes of one scale
_UNITS = (("rad/s", 1.0), ("mrad/s", 1e-3), ("\u00b5rad/s", 1e-6))
_TOUCHES = 2.0  # standard deviations of the real part by which a stable pole should keep off the imaginary axis


def plot_poles_zeros(found: Fit | PredictorFit | LinearModels, *, arm_angle: float = 0.0) -> Picture:
    """Draw poles and zeros from current to cart position with ellipses of two standard deviations.

    Args:
        found: a fit of a physical model, which is linearised, or linear models of many conditions.
        arm_angle: about which a physical model is linearised [rad].

    Raises:
        ValueError: as `rtac_jax.linearise`.
    """
    if isinstance(found, LinearModels):
        every = [one.unknowns.root_covariances() for one in list(found)[:: max(1, len(found) // _MOST)]]
        sets = [(Roots(*poles), Roots(*zeros)) for poles, zeros in every]
        whose = f"{len(found)} linear models"
    else:
        sets, whose = [model_roots(found, arm_angle=arm_angle)], "the fitted model"
    times = _enlargement([roots for pair in sets for roots in pair])
    near = _modes(*sets[0]) if len(sets) == 1 and times > 1 else []
    if near:
        figure, times = picture(8.6, 6.0), 0
        cells = figure.add_gridspec(len(near), 2, width_ratios=(2.4, 1.0))
        axes = figure.add_subplot(cells[:, 0])
        for row, mode in enumerate(near):
            _from_near(figure.add_subplot(cells[row, 1]), *mode)
    else:
        figure = picture(6.8, 6.0)
        axes = figure.subplots()
    for number, (poles, zeros) in enumerate(sets):
        _draw(axes, poles, times, "x", _POLE, "poles" if number == 0 else None)
        _draw(axes, zeros, times, "o", _ZERO, "zeros" if number == 0 and len(zeros.values) else None)
    axes.axhline(0, color="black", linewidth=0.6)
    axes.axvline(0, color="black", linewidth=0.6)
    axes.margins(0.15)
    drawn = "at the right, from near by" if near else "2 std" if times == 1 else f"2 std, drawn {times} times as large"
    axes.set_xlabel(f"Real part [rad/s]   (ellipses: {drawn})", fontsize=SMALL)
    axes.set_ylabel("Imaginary part [rad/s]", fontsize=SMALL)
    axes.legend(fontsize=SMALL, loc="best")
    tidy(axes)
    title(figure, _finding(sets, whose))
    return figure


def _enlargement(every: list[Roots]) -> int:
    """Return the round number by which ellipses are enlarged so that the largest can be seen: 1 where it can be anyhow."""
    values: Any = np.concatenate([roots.values for roots in every])
    span = np.maximum([np.ptp(values.real), np.ptp(values.imag)], 1e-300)
    reach = [np.max(np.abs(ellipse(c)), axis=1) / span for roots in every for c in roots.covariance]
    largest = float(np.max(reach, initial=0.0))
    if not 0 < largest < _SMALL:
        return 1
    decade = 10 ** np.floor(np.log10(_SHOWN / largest))
    return int(decade * max(step for step in (1, 2, 5) if step * decade * largest <= _SHOWN))


def _modes(poles: Roots, zeros: Roots) -> list[tuple[complex, np.ndarray, str, str]]:
    """Return value, covariance, colour and word of the poles and zeros above the real axis, on which ellipses are lines."""
    found = []
    for roots, colour, word in ((poles, _POLE, "pole"), (zeros, _ZERO, "zero")):
        for value, covariance in zip(np.asarray(roots.values), roots.covariance, strict=True):
            if value.imag > 0:
                found.append((complex(value), np.asarray(covariance), colour, word))
    return found[:_CLOSE]


def _from_near(axes: Axes, value: complex, covariance: np.ndarray, colour: str, word: str) -> None:
    """Draw the ellipse of two standard deviations around a pole or zero, both axes at one scale."""
    x, y = ellipse(covariance)
    real, imaginary = np.sqrt(np.diag(covariance))
    reach = 1.3 * max(float(np.max(np.abs(x))), float(np.max(np.abs(y))), 1e-300)
    unit, size = next(((u, s) for u, s in _UNITS if reach >= s), _UNITS[-1])
    axes.plot(x / size, y / size, color=colour, linewidth=1.1)
    axes.plot(0, 0, "x" if word == "pole" else "o", color=colour, fillstyle="none", markersize=6)
    axes.set(xlim=(-reach / size, reach / size), ylim=(-reach / size, reach / size), aspect="equal")
    axes.tick_params(labelsize=7)
    axes.set_title(
        f"{word} at {value.real:.4g} \u00b1 {real:.1g}\nand {value.imag:.5g} \u00b1 {imaginary:.1g} rad/s; ellipse: 2 std",
        fontsize=8,
        loc="left",
    )
    axes.set_xlabel(f"Real part, from there [{unit}]", fontsize=7)
    axes.set_ylabel(f"Imaginary part, from there [{unit}]", fontsize=7)
    tidy(axes)


def _draw(axes: Axes, roots: Roots, times: int, mark: str, colour: str, label: str | None) -> None:
    values: Any = roots.values
    axes.plot(
        values.real,
        values.imag,
        mark,
        color=colour,
        fillstyle="none",
        markersize=7,
        label=label,
        linestyle="none",
    )
    for value, covariance in zip(values, roots.covariance, strict=True) if times else ():
        x, y = ellipse(covariance)
        axes.plot(value.real + times * x, value.imag + times * y, color=colour, linewidth=0.9)


def _finding(sets: list[tuple[Roots, Roots]], whose: str) -> str:
    near, far = 0, 0.0
    for poles, _ in sets:
        values: Any = poles.values
        std = np.sqrt(poles.covariance[:, 0, 0])
        oscillating = values.imag > 0
        near += int(np.any(values.real[oscillating] > -_TOUCHES * std[oscillating]))
        far = max(far, float(np.max(std / np.maximum(np.abs(values), 1e-300), initial=0.0)))
    if near:
        count = f" in {near} of {len(sets)}" if len(sets) > 1 else ""
        return f"Poles of {whose}: the damping of a mode is not known from zero{count}"
    return (
        f"Poles of {whose}: every mode is damped, and the real parts are known to {100 * far:.2g} % of the poles' size"
    )
