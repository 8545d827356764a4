"""Pictures of prediction error fits: responses and residuals of all conditions, what drifts, and innovations."""

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from estimators.linear.fit import LinearModels
from estimators.linear.homogeneity_test import Equality
from estimators.plots.envelope import decibel, degrees, frequency_axis, gain_label
from estimators.plots.style import MARKERS, NOISE, SMALL, Picture, picture, tidy, title
from estimators.prediction_error.fit import PredictorFit

_LINE: dict[str, Any] = {"color": "0.35", "linewidth": 0.8}
_BAND: dict[str, Any] = {"color": "#fdd0a2", "linewidth": 0}
_MARK: dict[str, Any] = {"color": "#08306b", "linewidth": 1.2}
_MOST = 60
_WORDS = {"amplitude": "Output rms", "angle": "cos² of the mean arm angle [1]", "time": "Number of the condition"}


def plot_prediction_error(found: LinearModels, omega: Float[np.ndarray, " frequency"] | None = None) -> Picture:
    """Draw magnitude and phase of every condition with 95 % bands, and the correlations of their residuals."""
    grid = _grid(found) if omega is None else omega
    responses = found.responses(grid)
    figure = picture(8.0, 7.0)
    parts = figure.subplots(3, 2, height_ratios=[1.9, 1.0, 1.2])
    for axes in parts[:2].ravel():
        axes.remove()
    top = figure.add_subplot(parts[0, 0].get_gridspec()[0, :])
    below = figure.add_subplot(parts[0, 0].get_gridspec()[1, :], sharex=top)
    every = list(responses)[:: max(1, len(responses) // _MOST)]
    for number, one in enumerate(every):
        size, radius = np.abs(one.response), one.radius(0.95)
        top.fill_between(
            grid, decibel(np.maximum(size - radius, 0.05 * size)), decibel(size + radius),
            label="95 % of each" if number == 0 else None, **_BAND,
        )  # fmt: skip
    for one in every:
        top.semilogx(grid, decibel(np.abs(one.response)), **_LINE)
        below.semilogx(grid, degrees(one.response), **_LINE)
    top.set_ylabel(gain_label(responses[0]), fontsize=SMALL)
    top.legend(fontsize=SMALL, loc="best")
    below.set_ylabel("Phase [deg]", fontsize=SMALL)
    below.set_yticks(np.arange(-180, 181, 90))
    below.set_ylim(-200, 200)
    below.set_xlabel("Frequency [rad/s]", fontsize=SMALL)
    for axes in (top, below):
        frequency_axis(axes)
    _correlations(parts[2, 0], parts[2, 1], found)
    sound = sum(one.residuals.white and one.residuals.independent for one in found)
    kind = found.structure.kind.replace("_", " ")
    modes = "1 mode" if found.structure.modes == 1 else f"{found.structure.modes} modes"
    title(
        figure,
        f"{kind} with {modes}: the residuals of {sound} of {len(found)} conditions are white and independent of the input",
    )
    return figure


def _correlations(left: Axes, right: Axes, found: LinearModels) -> None:
    """Draw the correlations in units of the 99 % band of each condition."""
    for one in found:
        tests = one.residuals
        lags = np.arange(1, len(tests.autocorrelation) + 1)
        left.plot(lags, tests.autocorrelation / tests.white_band, **_LINE)
        both = [(tests.feedback_correlation / tests.feedback_band)[::-1], tests.cross_correlation / tests.cross_band]
        right.plot(np.concatenate([-lags[::-1], [0], lags]), np.concatenate(both), **_LINE)
    for axes, words in (
        (left, "Autocorrelation of the\nerrors / 99 % band"),
        (right, "Correlation with the\ninput / 99 % band"),
    ):
        axes.axhspan(-1, 1, zorder=0, **NOISE)
        axes.set_xlabel("Lag [samples]", fontsize=SMALL)
        axes.set_ylabel(words, fontsize=SMALL)
        largest = max(float(np.max(np.abs(line.get_ydata()))) for line in axes.get_lines())
        axes.set_ylim(-max(1.5, 1.05 * largest), max(1.5, 1.05 * largest))
        tidy(axes)


def plot_equality(found: Equality) -> Picture:
    """Draw each quantity of each condition with 95 % bars, beside the common value, over what it drifts with."""
    figure = picture(8.4, 1.75 * len(found.names) + 0.7)
    for i, (axes, name) in enumerate(
        zip(np.atleast_1d(figure.subplots(len(found.names), 1)), found.names, strict=True)
    ):
        trend = found.best_trend(name) if name in found.drifting else None
        if trend is None:
            # As in the order of time, conditions that are left out keep their number.
            number = np.arange(1, len(found.conditions) + 1, dtype=float)
            x, words = found.covariates.get("time", number), _WORDS["time"]
        else:
            x, words = found.covariates[trend.covariate], _WORDS.get(trend.covariate, trend.covariate)
        if words == _WORDS["time"]:
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        common, spread = found.common[i], 1.96 * found.common_std[i]
        axes.axhspan(common - spread, common + spread, zorder=0, **NOISE)
        axes.axhline(common, color="black", linewidth=0.8)
        axes.errorbar(
            x, found.values[:, i], 1.96 * found.std[:, i], fmt=MARKERS[0], markersize=3.5, elinewidth=0.8, **_MARK
        )
        unit = found.units[i]
        axes.set_ylabel(f"{name[0].upper()}{name[1:]}\n[{unit}]", fontsize=SMALL)
        axes.set_xlabel(words, fontsize=SMALL)
        tidy(axes)
    drifting = found.drifting
    if found.equal:
        title(figure, f"{len(found.conditions)} conditions have one set of parameters")
    else:
        trend = found.best_trend(drifting[0])
        with_what = f" with the {trend.covariate}" if trend else ""
        title(figure, f"Not one plant: {drifting[0]} {'drifts' if trend else 'scatters'}{with_what}")
    return figure


def plot_innovations(found: PredictorFit) -> Picture:
    """Draw the autocorrelation of the innovations of each channel, all experiments on top of each other."""
    channels = list(dict.fromkeys(w.channel for w in found.whiteness))
    figure = picture(8.0, 1.7 * len(channels) + 0.9)
    for axes, channel in zip(np.atleast_1d(figure.subplots(len(channels), 1, sharex=True)), channels, strict=True):
        for w in found.whiteness:
            if w.channel == channel:
                axes.plot(np.arange(1, len(w.autocorrelation) + 1), w.autocorrelation / w.band, **_LINE)
        axes.axhspan(-1, 1, zorder=0, **NOISE)
        axes.set_ylabel(f"{channel.replace('_', ' ')}\n/ 99 % band", fontsize=SMALL)
        tidy(axes)
    figure.axes[-1].set_xlabel("Lag [samples]", fontsize=SMALL)
    coloured = sum(w.p_value < 0.01 / len(found.whiteness) for w in found.whiteness)
    text = (
        "Innovations are white"
        if not coloured
        else f"Innovations are coloured in {coloured} of {len(found.whiteness)} channels"
    )
    title(figure, f"{text}: autocorrelation in units of its band")
    return figure


def _grid(found: LinearModels) -> Float[np.ndarray, " frequency"]:
    """Return frequencies from half a decade below the modes to half a decade above, as far as the samples reach."""
    rates = np.concatenate([np.abs(one.poles) for one in found])
    nyquist = np.pi / max(one.sample_time for one in found)
    return np.geomspace(0.3 * np.quantile(rates, 0.05), min(3 * np.quantile(rates, 0.95), nyquist), 300)
