"""The residuals of a simulation: in time, in correlation, in frequency, and by experiment."""

import numpy as np
from matplotlib.axes import Axes
from scipy.signal import welch

from estimators.plots.style import (
    HATCHES,
    NAMES,
    NOISE,
    RESIDUALS,
    SMALL,
    UNITS,
    Picture,
    picture,
    prefixed,
    thin,
    tidy,
    times,
    title,
)
from estimators.validation.simulation_error import Compared, Trace
from rtac_jax.measurement import filled

_MOST_BARS = 10
_LAGS = 50
_PEAK = 10.0  # a spectrum this many times above the noise floor has a peak worth naming
_INK = RESIDUALS[1]


def plot_residuals(compared: Compared) -> Picture:
    """Draw residual tests of the worst channel of the worst experiment, and the error of all experiments."""
    trace = compared.worst(1)[0]
    figure = picture(9.6, 6.0)
    grid = figure.add_gridspec(2, 3)
    _in_time(figure.add_subplot(grid[0, :2]), trace)
    _by_experiment(figure.add_subplot(grid[0, 2]), compared)
    _autocorrelation(figure.add_subplot(grid[1, 0]), trace)
    # Of the worst that was driven: a free decay has no input that could explain its residual.
    driven = next((t for t in compared.worst(len(compared.traces)) if np.any(t.current)), trace)
    _cross_correlation(figure.add_subplot(grid[1, 1]), driven)
    peak = _spectrum(figure.add_subplot(grid[1, 2]), trace)
    title(figure, _finding(compared, trace, peak))
    return figure


def _in_time(axes: Axes, trace: Trace) -> None:
    scale = prefixed(float(np.nanmax(np.abs(trace.residual), initial=0.0)), UNITS[trace.channel])
    axes.axhspan(-scale.factor * trace.noise, scale.factor * trace.noise, zorder=0, **NOISE)
    axes.plot(*thin(trace.time, scale.factor * trace.residual), color=_INK, linewidth=0.7)
    axes.set_xlabel("Time [s]   (grey band: ±1 std of the noise)", fontsize=SMALL)
    axes.set_ylabel(f"Residual [{scale.unit}]", fontsize=SMALL)
    axes.set_title(f"{NAMES[trace.channel]}, {trace.experiment}", fontsize=9, loc="left")
    tidy(axes)


def _by_experiment(axes: Axes, compared: Compared) -> None:
    names = list(dict.fromkeys(t.experiment for t in sorted(compared.traces, key=lambda t: -t.rms / t.noise)))
    shown = names[:_MOST_BARS]
    channels = list(dict.fromkeys(t.channel for t in compared.traces))
    height = 0.8 / len(channels)
    for number, channel in enumerate(channels):
        ratio = {t.experiment: t.rms / t.noise for t in compared.traces if t.channel == channel}
        rows = [(place, ratio[name]) for place, name in enumerate(shown) if name in ratio]
        axes.barh(
            [place + (number - 0.5 * (len(channels) - 1)) * height for place, _ in rows], [r for _, r in rows],
            height=height, color=("0.35", "0.85", "0.6")[number], hatch=HATCHES[number], edgecolor="black",
            linewidth=0.5, label=NAMES[channel],
        )  # fmt: skip
    axes.axvline(1.0, color="black", linestyle="--", linewidth=1)
    axes.set_yticks(range(len(shown)), shown)
    axes.invert_yaxis()
    if max(t.rms / t.noise for t in compared.traces) > 30:
        axes.set_xscale("log")
        axes.set_xlim(left=0.5)
    axes.set_xlabel("rms of residual / noise [1]", fontsize=SMALL)
    count = f"worst {len(shown)} of {len(names)}" if len(shown) < len(names) else f"all {len(names)}"
    axes.set_title(f"error by experiment ({count})", fontsize=9, loc="left")
    # Above the bars, which may reach across the whole axes.
    axes.legend(fontsize=7, loc="lower left", bbox_to_anchor=(0.0, 1.12), borderaxespad=0.0, frameon=False, ncols=2)
    tidy(axes)


def _autocorrelation(axes: Axes, trace: Trace) -> None:
    found, band = trace.autocorrelation(_LAGS)
    _stems(axes, found[1:], band, first=1)
    axes.set_xlabel("Lag [samples]", fontsize=SMALL)
    axes.set_ylabel("Autocorrelation [1]", fontsize=SMALL)
    axes.set_title(f"residual is {trace.colour}", fontsize=9, loc="left")


def _cross_correlation(axes: Axes, trace: Trace) -> None:
    axes.set_xlabel("Lag [samples]", fontsize=SMALL)
    axes.set_ylabel("Correlation with the input [1]", fontsize=SMALL)
    if not np.any(trace.current):
        axes.set_xlim(0, _LAGS)
        axes.set_ylim(-1, 1)
        axes.text(0.5, 0.5, "no input in\nthis experiment", transform=axes.transAxes, ha="center", va="center")
        axes.set_title("no input to correlate with", fontsize=9, loc="left")
        tidy(axes)
        return
    found = trace.input_correlation(_LAGS)
    _stems(axes, found.values, found.band, first=int(found.lags[0]))
    axes.axvline(0, color="black", linewidth=0.6, linestyle=":")
    axes.set_title(f"{trace.experiment}: {found.outside} of {_LAGS + 1} at lags ≥ 0 outside", fontsize=9, loc="left")
    axes.set_xlabel("Lag [samples]   (below 0: feedback)", fontsize=SMALL)


def _stems(axes: Axes, found: np.ndarray, band: float, *, first: int) -> None:
    lags = np.arange(first, first + len(found))
    axes.axhspan(-band, band, zorder=0, label="99 % band", **NOISE)
    axes.vlines(lags, 0, found, color=_INK, linewidth=1)
    axes.plot(lags, found, ".", color=_INK, markersize=3)
    axes.axhline(0, color="black", linewidth=0.6)
    reach = 1.15 * max(float(np.max(np.abs(found), initial=0.0)), 1.5 * band)
    axes.set_ylim(-reach, reach)
    axes.legend(fontsize=7, loc="lower right")
    tidy(axes)


def _spectrum(axes: Axes, trace: Trace) -> float | None:
    """Draw the spectrum, and return the frequency of a peak far above the noise [Hz], or None."""
    dt = float(trace.time[1] - trace.time[0])
    residual = filled(trace.residual[np.argmax(np.isfinite(trace.residual)) :])
    frequency, density = welch(residual, 1 / dt, window="hann", nperseg=min(len(residual), 512))
    frequency, density = frequency[1:], density[1:]
    floor = np.sqrt(2 * dt) * trace.noise
    scale = prefixed(max(float(np.sqrt(density.max())), floor), UNITS[trace.channel])
    axes.semilogy(frequency, scale.factor * np.sqrt(density), color=_INK, linewidth=0.9, label="residual")
    axes.axhline(scale.factor * floor, color="black", linestyle="--", linewidth=1, label="noise")
    if frequency[-1] > 50:
        axes.set_xscale("log")
    axes.set_xlabel("Frequency [Hz]", fontsize=SMALL)
    axes.set_ylabel(f"Spectrum [{scale.unit}/√Hz]", fontsize=SMALL)
    axes.legend(fontsize=7)
    tidy(axes)
    place = int(np.argmax(density))
    peak = float(frequency[place]) if density[place] > _PEAK * floor**2 else None
    axes.set_title("at the noise floor" if peak is None else f"peak at {peak:.2g} Hz", fontsize=9, loc="left")
    return peak


def _finding(compared: Compared, trace: Trace, peak: float | None) -> str:
    ratio = trace.rms / trace.noise
    where = f"{NAMES[trace.channel]} in {trace.experiment}"
    model = "The base model" if compared.label == "base" else f"The model {compared.label.replace('+ ', 'with ')}"
    model = "The model" if compared.label == "model" else model
    if ratio < 1.2:
        return f"{model} leaves nothing but noise: the worst, {where}, is {times(ratio)} times the noise"
    at = f", mostly at {peak:.2g} Hz ({2 * np.pi * peak:.0f} rad/s)" if peak is not None else ""
    return f"{model} leaves {times(ratio)} times the noise of {where}{at}"
