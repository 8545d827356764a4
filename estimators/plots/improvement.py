"""The error before and after, for the data that were fitted and for those held out."""

import itertools

from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, NullFormatter

from estimators.core.fit import FAR
from estimators.diagnosis.improvement import Improvement
from estimators.plots.comparison import draw_pair, same
from estimators.plots.style import MARKERS, NAMES, SMALL, Picture, picture, tidy, times, title
from estimators.validation.simulation_error import Comparison

_TONES = ("#08306b", "#e6550d", "#31a354")
_LONG_NAME = 20  # letters that stand side by side without touching


def plot_improvement(improvement: Improvement) -> Picture:
    """Draw the fall of the error from effect to effect, and the worst held-out experiment before and after."""
    figure = picture(9.6, 5.6)
    grid = figure.add_gridspec(2, 2, width_ratios=[1, 1.25], height_ratios=[2, 1])
    _ladder(figure.add_subplot(grid[:, 0]), improvement)
    models = improvement.validation.models
    # What the last model is still far from tells more than what the first was farthest from.
    last = models[-1].worst(1)[0]
    before = last if last.rms > FAR * last.noise else models[0].worst(1)[0]
    shown = [models[0]] if len(models) == 1 else [models[0], models[-1]]
    top, below = figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1, 1])
    labels = [m.label for m in shown]
    draw_pair(top, below, [same(m.traces, before) for m in shown], labels)
    top.set_title(f"held out: {top.get_title(loc='left')}", fontsize=9, loc="left")
    top.legend(fontsize=SMALL, loc="upper right", ncols=3, framealpha=0.85)
    title(figure, finding(improvement))
    return figure


def finding(improvement: Improvement) -> str:
    """Say in one line what was added and what it did to the held-out error of the worst channel."""
    first, last = improvement.validation.models[0].errors, improvement.validation.models[-1].errors
    if improvement.diagnoses[-1].silent and not improvement.added:
        return improvement.diagnoses[-1].silent
    channel = max(first, key=lambda c: first[c].rms_over_noise)
    before, after = first[channel].rms_over_noise, last[channel].rms_over_noise
    if len(improvement.validation.models) == 1:
        if improvement.verdict == "adequate":
            found = "No effect stands out, and yet" if before > FAR else "Nothing is missing:"
            return f"{found} the held-out error of {NAMES[channel]} is {times(before)} times the noise"
        if (differs := improvement.constancy) is not None and differs.decisive:
            one = "one value" if len(differs.varying) == 1 else "one set"
            return (
                f"Experiments differ in {' and '.join(differs.varying)}: with {one} for all the held-out error of "
                f"{NAMES[channel]} is {times(before)} times the noise"
            )
        return (
            f"No effect could be added: the held-out error of {NAMES[channel]} stays at {times(before)} times the noise"
        )
    learned = ["a learned force, which is no physical effect,"] if improvement.learned is not None else []
    near = [f"{improvement.nearest.id}, which is likely and not certain,"] if improvement.nearest is not None else []
    names = " and ".join(
        [*([", ".join(c.id for c in improvement.added)] if improvement.added else []), *near, *learned]
    )
    if improvement.predicted_gains and after > 0.95 * before:
        last = improvement.predicted_gains[-1]
        fall = f"from {times(last.before[last.channel])} to {times(last.after[last.channel])} times the noise"
        return f"With {names} the held-out {NAMES[last.channel]} is predicted one sample ahead better, {fall}"
    fall = f"from {times(before)} to {times(after)} times the noise"
    means = []
    means += [f"adding {names}"] if names else []
    means += [f"leaving {improvement.left_out} out of the fit"] if improvement.left_out is not None else []
    how = " and ".join(means)
    verb = "lowers" if after < before else "raises"
    return f"{how[0].upper()}{how[1:]} {verb} the held-out error of {NAMES[channel]} {fall}"


def _ladder(axes: Axes, improvement: Improvement) -> None:
    steps = range(len(improvement.validation.models))
    values = [1.0]
    ends: list[tuple[float, float]] = []
    for number, channel in enumerate(improvement.validation.models[0].errors):
        for which, comparison in (("held out", improvement.validation), ("fitted", improvement.train)):
            ratios = _ratios(comparison, channel)
            held_out = which == "held out"
            axes.semilogy(
                steps, ratios, color=_TONES[number], marker=MARKERS[number], markersize=7,
                markerfacecolor=_TONES[number] if held_out else "white", linestyle="-" if held_out else "--",
                linewidth=1.4, label=f"{NAMES[channel]}, {which}",
            )  # fmt: skip
            values += ratios
            if held_out:
                ends.append((ratios[0], ratios[-1]))
    axes.axhspan(1e-9, 1.0, color="0.93", zorder=0)
    axes.axhline(1.0, color="black", linestyle=":", linewidth=1.2)
    low, high = min(values), max(values)
    axes.set_ylim(low / 1.5, high * (high / low) ** 0.45)  # room for the legend
    last = len(steps) - 1
    axes.set_xlim(-0.3 * max(last, 1), last + 0.3 * max(last, 1))
    _numbers(axes, 0, [first for first, _ in ends], left=True)
    if last:
        _numbers(axes, last, [final for _, final in ends], left=False)
    axes.text(0.01, 1 / 1.03, "noise floor", transform=axes.get_yaxis_transform(), va="top", fontsize=SMALL)
    names = _rungs(improvement)
    long = max(len(line) for name in names for line in name.split("\n")) > _LONG_NAME and len(names) > 2
    axes.set_xticks(list(steps), names, rotation=20 if long or len(names) > 3 else 0)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    if high / low > 10:
        axes.yaxis.set_minor_formatter(NullFormatter())
    else:
        axes.yaxis.set_minor_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_ylabel("rms of residual / noise [1]", fontsize=SMALL)
    axes.set_title("simulation error", fontsize=9, loc="left")
    axes.legend(fontsize=7.5, loc="upper right")
    tidy(axes)


def _rungs(improvement: Improvement) -> list[str]:
    """Return what each model has more than the one before, or was fitted without."""
    labels = [model.label for model in improvement.validation.models]
    new = [now.removeprefix(before).removeprefix(", ") for before, now in itertools.pairwise(labels)]
    bare = [name.removeprefix("+ ").replace(", ", ",\n") for name in new]
    names = ["base", *(name if name.startswith("without ") else f"+ {name}" for name in bare)]
    if improvement.nearest is not None:
        names[-1 if improvement.left_out is None else -2] = f"+ {improvement.nearest.id}, likely"
    return names


def _numbers(axes: Axes, step: int, ratios: list[float], *, left: bool) -> None:
    """Write values beside their markers, moved apart where they would cover each other."""
    low, high = axes.get_ylim()
    gap = (high / low) ** 0.045
    place = 0.0
    for ratio in sorted(ratios):
        place = max(ratio, place * gap)
        axes.annotate(
            times(ratio), (step, place), textcoords="offset points", xytext=(-8 if left else 8, 0),
            ha="right" if left else "left", va="center", fontsize=SMALL,
        )  # fmt: skip


def _ratios(comparison: Comparison, channel: str) -> list[float]:
    return [m.errors[channel].rms_over_noise if channel in m.errors else float("nan") for m in comparison.models]
