"""Bode plot of a fitted physical model with its confidence band over measured responses."""

import numpy as np
from jaxtyping import Float

from estimators.core.fit import Fit
from estimators.frequency_response.response import FrequencyResponses
from estimators.inference.model_response import model_response
from estimators.plots.envelope import decibel, degrees, frequency_axis, gain_label
from estimators.plots.style import SMALL, Picture, picture, title
from estimators.prediction_error.fit import PredictorFit

_POINTS = 800


def plot_bode(
    fit: Fit | PredictorFit,
    responses: FrequencyResponses,
    *,
    arm_angle: float = 0.0,
    omega: Float[np.ndarray, " frequency"] | None = None,
) -> Picture:
    """Draw magnitude and phase of the linearised model with its 95 % band, and the measured responses with theirs.

    Dry friction has no linearisation: where a measured resonance is lower than the model's, friction damps it.

    Args:
        fit: of a physical model.
        responses: from current times cos(theta) to cart position.
        arm_angle: about which the model is linearised [rad].
        omega: frequencies of the model's curve [rad/s]; by default those of the responses, closer together.

    Raises:
        ValueError: as `model_response`, or responses of other channels.
    """
    responses.require("current", "cart_position")
    low, high = (pick([pick(one.frequency) for one in responses]) for pick in (np.min, np.max))
    grid = np.geomspace(low, high, _POINTS) if omega is None else omega
    fitted = model_response(fit, grid, arm_angle=arm_angle)
    figure = picture(8.0, 5.8)
    top, below = figure.subplots(2, 1, sharex=True, height_ratios=[2, 1])
    inside = total = 0
    for number, one in enumerate(responses):
        size, radius = np.abs(one.response), one.radius(0.95)
        distance = np.abs(np.interp(one.frequency, grid, np.abs(fitted.response)) - size)
        inside, total = inside + int(np.sum(distance <= radius)), total + len(size)
        top.fill_between(
            one.frequency, decibel(np.maximum(size - radius, 0.05 * size)), decibel(size + radius), color="0.85",
            linewidth=0, label="95 % of each measured response" if number == 0 else None,
        )  # fmt: skip
        top.semilogx(one.frequency, decibel(size), ".", color="0.45", markersize=2.5)
        below.semilogx(one.frequency, degrees(one.response), ".", color="0.45", markersize=2.5)
    size, radius = np.abs(fitted.response), fitted.radius(0.95)
    top.fill_between(
        grid, decibel(np.maximum(size - radius, 0.05 * size)), decibel(size + radius), color="#fdae6b", linewidth=0,
        label="95 % of the model, by its parameters",
    )  # fmt: skip
    top.semilogx(grid, decibel(size), color="#08306b", linewidth=1.6, label="fitted model, linearised")
    below.semilogx(grid, degrees(fitted.response), color="#08306b", linewidth=1.6)
    top.set_ylabel(gain_label(fitted), fontsize=SMALL)
    below.set_ylabel("Phase [deg]", fontsize=SMALL)
    below.set_yticks(np.arange(-180, 181, 90))
    below.set_ylim(-200, 200)
    below.set_xlabel("Frequency [rad/s]", fontsize=SMALL)
    top.legend(fontsize=SMALL, loc="best")
    for axes in (top, below):
        frequency_axis(axes)
    peak, at = float(decibel(np.array([size.max()]))[0]), float(grid[np.argmax(size)])
    title(
        figure,
        f"The fitted model peaks with {peak:.1f} dB at {at:.3g} rad/s; {100 * inside / total:.0f} % of the measured magnitudes "
        "hold it within their 95 % bands",
    )
    return figure
