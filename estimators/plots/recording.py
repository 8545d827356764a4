"""A quick look at the raw channels of a recording."""

import numpy as np
from matplotlib.axes import Axes

from estimators.plots.style import (
    NAMES,
    SMALL,
    UNITS,
    Picture,
    axis,
    label,
    largest,
    picture,
    prefixed,
    thin,
    tidy,
    title,
)
from rtac_jax.measurement import INPUTS, OUTPUTS, Experiment, Recording, Signal

_MOST = 4


def plot_recording(recording: Recording) -> Picture:
    """Draw the raw channels of up to four experiments, of every kind and spread over the recording."""
    shown = _chosen(recording)
    channels = [c for c in (*INPUTS, *OUTPUTS) if any(c in _signals(e) for e in shown)]
    figure = picture(max(8.0, 2.4 * len(shown)), 1.4 + 1.35 * len(channels))
    axes = figure.subplots(len(channels), len(shown), squeeze=False, sharex="col", sharey="row")
    for row, channel in enumerate(channels):
        holders = [_signals(e)[channel].values for e in shown if channel in _signals(e)]
        scale = axis(channel, *holders)
        for column, experiment in enumerate(shown):
            panel = axes[row, column]
            _draw(panel, experiment, channel, scale.factor)
            if column == 0:
                name, unit = label(channel, scale.unit).rsplit(" ", 1)
                panel.set_ylabel(
                    f"{name}\n{unit}".replace(" ", "\n", 1) if len(name) > 14 else f"{name}\n{unit}", fontsize=SMALL
                )
            if row == 0:
                panel.set_title(f"{experiment.name} ({experiment.kind})", fontsize=9, loc="left")
            if row == len(channels) - 1:
                panel.set_xlabel("Time [s]", fontsize=SMALL)
    title(figure, _finding(recording, shown))
    return figure


def _draw(panel: Axes, experiment: Experiment, channel: str, factor: float) -> None:
    tidy(panel)
    signals = _signals(experiment)
    if channel not in signals:
        absent = "no input" if channel in INPUTS else "not recorded"
        panel.text(0.5, 0.5, absent, transform=panel.transAxes, ha="center", va="center", fontsize=SMALL, color="0.4")
        return
    signal = signals[channel]
    panel.plot(
        *thin(experiment.time, factor * signal.values),
        color="#e6550d" if channel in INPUTS else "#08306b",
        linewidth=0.8,
        drawstyle="steps-post" if signal.intersample == "zoh" else "default",
    )


def _signals(experiment: Experiment) -> dict[str, Signal]:
    return {**experiment.inputs, **experiment.outputs}


def _chosen(recording: Recording) -> list[Experiment]:
    """Return one experiment of every kind first, then more, in the order of the recording."""
    everything = list(recording.experiments)
    found = [next(e for e in everything if e.kind == kind) for kind in dict.fromkeys(e.kind for e in everything)]
    found += [e for e in everything if e not in found and e.kind != "rest"]
    kept = {e.name for e in found[:_MOST]}
    return [e for e in everything if e.name in kept]


def _finding(recording: Recording, shown: list[Experiment]) -> str:
    kinds = [e.kind for e in recording.experiments]
    counts = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
    ranges = []
    for channel in OUTPUTS:
        values = [e.outputs[channel].values for e in recording.experiments if channel in e.outputs]
        if values:
            size = max(largest(v) for v in values)
            scale = prefixed(size, UNITS[channel])
            ranges.append(f"{NAMES[channel]} up to {scale.factor * size:.3g} {scale.unit}")
    count = len(recording.experiments)
    some = f"{len(shown)} of {count}" if len(shown) < count else f"all {count}"
    length = float(np.sum([e.duration for e in recording.experiments]))
    return f"{counts} in {length:.3g} s; {', '.join(ranges)} ({some} experiments shown)"
