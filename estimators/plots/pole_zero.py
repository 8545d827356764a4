"""Poles and zeros of a fitted model in the complex plane, with ellipses of two standard deviations."""

from typing import Any

import numpy as np

from estimators.core.fit import Fit
from estimators.core.parameter_correlation import ellipse
from estimators.inference.model_response import Roots, model_roots
from estimators.linear.fit import LinearModels
from estimators.plots.style import SMALL, Picture, picture, tidy, title
from estimators.prediction_error.fit import PredictorFit

_MOST = 60  # conditions
_POLE, _ZERO = "#08306b", "#e6550d"
_SMALL, _SHOWN = (
    0.02,
    0.12,
)  # of the spread of poles and zeros: an ellipse that is not seen, and up to which it is enlarged
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
    figure = picture(6.8, 6.0)
    axes = figure.subplots()
    times = _enlargement([roots for pair in sets for roots in pair])
    for number, (poles, zeros) in enumerate(sets):
        _draw(axes, poles, times, "x", _POLE, "poles" if number == 0 else None)
        _draw(axes, zeros, times, "o", _ZERO, "zeros" if number == 0 and len(zeros.values) else None)
    axes.axhline(0, color="black", linewidth=0.6)
    axes.axvline(0, color="black", linewidth=0.6)
    axes.margins(0.15)
    drawn = "" if times == 1 else f", drawn {times} times as large"
    axes.set_xlabel(f"Real part [rad/s]   (ellipses: 2 std{drawn})", fontsize=SMALL)
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


def _draw(axes: Any, roots: Roots, times: int, mark: str, colour: str, label: str | None) -> None:
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
    for value, covariance in zip(values, roots.covariance, strict=True):
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
