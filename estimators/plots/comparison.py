"""The measurements against one or several models, where these fail most."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from estimators.plots.style import (
    MEASURED,
    MODELS,
    NAMES,
    NOISE,
    RESIDUALS,
    SMALL,
    UNITS,
    Picture,
    axis,
    label,
    picture,
    prefixed,
    thin,
    tidy,
    times,
    title,
    worst_stretch,
)
from estimators.validation.simulation_error import Compared, Comparison, Trace

_MOST_MODELS = 4


def plot_comparison(comparison: Comparison, *, worst: int | None = None) -> Picture:
    """Draw measurements and simulations of every channel's worst experiments, with residuals and noise below.

    Args:
        comparison: of one or several models.
        worst: experiments to show of each channel; by default two, or one where there are three channels.
    """
    models = _shown(comparison)
    channels = list(dict.fromkeys(t.channel for t in models[0].traces))
    rows = worst if worst is not None else (1 if len(channels) > 2 else 2)
    chosen = {channel: _worst_of(models[0].traces, channel, rows) for channel in channels}
    rows = max(len(traces) for traces in chosen.values())
    figure = picture(max(8.0, 4.2 * len(channels)), 1.2 + 3.4 * rows)
    grid = figure.add_gridspec(2 * rows, len(channels), height_ratios=[2, 1] * rows)
    for column, channel in enumerate(channels):
        for row, trace in enumerate(chosen[channel]):
            top = figure.add_subplot(grid[2 * row, column])
            below = figure.add_subplot(grid[2 * row + 1, column])
            draw_pair(top, below, [same(m.traces, trace) for m in models], [m.label for m in models])
            if row == 0 and column == 0:
                top.legend(fontsize=SMALL, loc="upper right", ncols=2, framealpha=0.85)
    title(figure, _finding(comparison, models, rows))
    return figure


def draw_pair(top: Axes, below: Any, traces: list[Trace], labels: list[str]) -> None:
    """Draw one channel of one experiment: measured and simulated above, residuals and noise below."""
    first = traces[0]
    near = worst_stretch(first.residual)
    whole = near.stop - near.start == len(first.time)
    scale = axis(first.channel, first.measured[near])
    top.plot(first.time[near], scale.factor * first.measured[near], label="measured", **MEASURED)
    for trace, name, style in zip(traces, labels, MODELS, strict=False):
        top.plot(trace.time[near], scale.factor * trace.simulated[near], label=name, **style)
    ratios = " → ".join(times(t.rms / t.noise) for t in traces)
    top.set_title(f"{first.experiment}: rms {ratios} × noise", fontsize=9, loc="left")
    top.set_ylabel(label(first.channel, scale.unit), fontsize=SMALL)
    low, high = top.get_ylim()
    top.set_ylim(low, high + 0.22 * (high - low))  # room for the legend
    tidy(top)
    unit = prefixed(max(np.nanmax(np.abs(t.residual), initial=0.0) for t in traces), UNITS[first.channel])
    below.axhspan(-unit.factor * first.noise, unit.factor * first.noise, zorder=0, **NOISE)
    for trace, colour in zip(traces, RESIDUALS, strict=False):
        below.plot(*thin(trace.time, unit.factor * trace.residual), color=colour, linewidth=0.7)
    if not whole:
        below.axvspan(first.time[near.start], first.time[near.stop - 1], color="#fff7bc", zorder=-1)
        top.text(0.01, 0.02, "worst stretch", transform=top.transAxes, fontsize=SMALL)
    below.set_ylabel(f"Residual [{unit.unit}]", fontsize=SMALL)
    below.set_xlabel("Time [s]   (grey band: ±1 std of the noise)", fontsize=SMALL)
    tidy(below)


def _shown(comparison: Comparison) -> list[Compared]:
    """Return the first models and always the last one."""
    models = list(comparison.models)
    return models if len(models) <= _MOST_MODELS else [*models[: _MOST_MODELS - 1], models[-1]]


def _worst_of(traces: tuple[Trace, ...], channel: str, count: int) -> list[Trace]:
    return sorted((t for t in traces if t.channel == channel), key=lambda t: -t.rms / t.noise)[:count]


def same(traces: tuple[Trace, ...], like: Trace) -> Trace:
    """Return the trace of the same channel in the same experiment."""
    return next(t for t in traces if (t.experiment, t.channel) == (like.experiment, like.channel))


def _finding(comparison: Comparison, models: list[Compared], rows: int) -> str:
    first = max(models[0].traces, key=lambda t: t.rms / t.noise)
    before = first.rms / first.noise
    count = len({t.experiment for t in models[0].traces})
    shown = f"(worst {min(rows, count)} of {count} experiments for each channel)"
    where = f"{NAMES[first.channel]} in {first.experiment}"
    if len(models) == 1:
        if before < 1.2:
            return f"The model follows every experiment to {times(before)} times the noise or better {shown}"
        return f"The model fails most in {where}, by {times(before)} times the noise {shown}"
    if not models[-1].label.startswith("+ "):
        at_worst = sorted((max(t.rms / t.noise for t in model.traces), model.label) for model in models)
        (least, best), *others = at_worst
        beside = ", ".join(f"{name} {times(value)}" for value, name in others)
        return f"{best} follows the data best, to {times(least)} times the noise at worst; {beside} {shown}"
    last = same(models[-1].traces, first)
    after = last.rms / last.noise
    verb = "falls" if after < before else "rises"
    with_what = models[-1].label.replace("+ ", "with ")
    return (
        f"The largest error, {where}, {verb} from {times(before)} to {times(after)} times the noise {with_what} {shown}"
    )
