"""The next experiment: the separation by each of the candidate set, and the course of the recommended one."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from estimators.experiment_design.next_experiment import CONFUSABLE, NextExperiment
from estimators.plots.style import SMALL, Picture, axis, label, picture, tidy, title

_MOST_BARS = 14
_SHOWN = ("current", "cart_position", "arm_velocity")


def plot_next_experiment(found: NextExperiment) -> Picture:
    """Draw the smallest separation by experiment, beside inputs and predicted outputs of the recommended one."""
    figure = picture(9.6, 5.4)
    recommended = found.recording.experiments[0]
    signals = {**recommended.inputs, **recommended.outputs}
    shown = [c for c in _SHOWN if c in signals]
    grid = figure.add_gridspec(len(shown), 2, width_ratios=[1.25, 1])
    _bars(figure.add_subplot(grid[:, 0]), found)
    first: Any = None
    for row, channel in enumerate(shown):
        axes = figure.add_subplot(grid[row, 1], sharex=first)
        first = first or axes
        values = np.asarray(signals[channel].values)
        scale = axis(channel, values)
        driven = channel in recommended.inputs
        axes.plot(
            np.asarray(recommended.time), scale.factor * values, color="#08306b" if driven else "0.35", linewidth=0.9,
            drawstyle="steps-post" if driven else "default",
        )  # fmt: skip
        axes.set_ylabel(label(channel, scale.unit).replace(" [", "\n["), fontsize=SMALL)
        axes.set_title("to be played" if driven else "predicted", fontsize=SMALL, loc="right")
        tidy(axes)
        axes.tick_params(labelbottom=row == len(shown) - 1)
    first.figure.axes[-1].set_xlabel("Time [s]", fontsize=SMALL)
    title(figure, finding(found))
    return figure


def finding(found: NextExperiment) -> str:
    """Say in one line what is recommended, with the numbers that carry it."""
    effects = " and ".join(found.effects) if len(found.effects) < 4 else f"{len(found.effects)} effects"
    now, then = min(found.already.values()), found.best.smallest
    if then < CONFUSABLE:
        return f"No experiment that was tried tells {effects} apart; {found.plan.name} comes nearest: separation {_two(then)}"
    return f"“{found.plan.name}” tells {effects} apart: separation {_two(then)}, {_two(now)} as it stands"


def _bars(axes: Axes, found: NextExperiment) -> None:
    shown = found.ranked[:_MOST_BARS]
    now = min(found.already.values())
    values = [one.smallest for one in shown]
    low = 0.5 * min(CONFUSABLE, max(now, 1e-2), *(max(v, 1e-2) for v in values))
    for row, value in enumerate(values):
        best = row == 0
        axes.barh(
            row, max(value, low) - low, left=low, height=0.62, edgecolor="black", linewidth=0.6,
            color="#08306b" if best else "0.8" if value >= CONFUSABLE else "0.97",
        )  # fmt: skip
        axes.annotate(
            _two(value), (max(value, low), row), xytext=(3, 0), textcoords="offset points", va="center", fontsize=7.5
        )
    axes.set_xscale("log")
    axes.set_xlim(low, 4 * max(*values, 2 * CONFUSABLE))
    lines = ((CONFUSABLE, "--", "told apart from here on"), (now, ":", "as it stands"))
    for height, (at, style, words) in enumerate(lines):
        if at > low:
            axes.axvline(at, color="black", linestyle=style, linewidth=1)
            axes.text(at, -0.75 - 0.7 * height, f" {words} ({_two(at)})", fontsize=7.5, ha="left", va="center")
    axes.set_yticks(range(len(shown)), [f"{'★ ' if row == 0 else ''}{one.plan.name}" for row, one in enumerate(shown)])
    axes.set_ylim(len(shown) - 0.4, -1.9)
    axes.set_xlabel("Smallest separation, with what is recorded: twice the log-likelihood gain [1]", fontsize=SMALL)
    axes.xaxis.set_label_coords(0.2, -0.07)
    more = f"first {len(shown)} of {len(found.ranked)}" if len(shown) < len(found.ranked) else f"{len(shown)}"
    axes.set_title(f"experiments within the limits ({more}); ★ recommended", fontsize=9, loc="left")
    tidy(axes)
    axes.grid(False, axis="y")
    axes.tick_params(axis="y", labelsize=7.5)


def _two(value: float) -> str:
    return f"{float(f'{value:.2g}'):,.0f}" if value >= 10 else f"{value:.2g}"
