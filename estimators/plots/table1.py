"""Estimates of every experiment beside their mean: Table 1 as a picture."""

import numpy as np

from estimators.closed_form.table1 import PAPER, SYMBOLS, ClosedForm
from estimators.plots.style import MODELS, SMALL, Picture, picture, tidy, title

_RULE = 30.0  # percent; the paper's


def plot_table_1(found: ClosedForm) -> Picture:
    """Draw each experiment's estimate beside the mean, in percent of it, and the scatter beside the paper's.

    Raises:
        ValueError: nothing was estimated from any experiment.
    """
    columns = dict(found.ratios) | {SYMBOLS[n]: found.estimates[n] for n in SYMBOLS if n in found.estimates}
    if not columns:
        raise ValueError("no experiment served the closed form, so there is nothing to draw.")
    paper = {SYMBOLS.get(n, n): printed for n, printed in PAPER.items()}
    figure = picture(9.6, 4.2)
    left, right = figure.subplots(1, 2, width_ratios=(2, 1))
    places = np.arange(len(columns))
    for place, e in zip(places, columns.values(), strict=True):
        off = 100 * (e.each / e.value - 1)
        left.plot(place + np.linspace(-0.3, 0.3, len(off)), off, "o", color=MODELS[1]["color"], markersize=4)
    left.axhline(0, color="black", linewidth=0.8)
    for bound in (-_RULE, _RULE):
        left.axhline(bound, color=MODELS[0]["color"], linestyle="--", linewidth=1)
    left.set_yscale("symlog", linthresh=1.0)
    left.set_yticks([-30, -10, -1, 0, 1, 10, 30], ["-30", "-10", "-1", "0", "1", "10", "30"])
    left.set_xticks(places, list(columns))
    left.set_ylabel("Estimate less mean [% of the mean]", fontsize=SMALL)
    left.set_title("each point one experiment (dashed: ±30 %)", fontsize=9, loc="left")
    scatter = np.array([100 * e.consistency for e in columns.values()])
    right.plot(scatter, places, "o", color=MODELS[1]["color"], label="here")
    right.plot(
        [100 * paper[n].consistency for n in columns], places, "s", mfc="none", color=MODELS[0]["color"], label="paper"
    )
    right.axvline(_RULE, color=MODELS[0]["color"], linestyle="--", linewidth=1)
    right.set_xscale("log")
    right.set_yticks(places, list(columns))
    right.invert_yaxis()
    right.set_xlabel("Standard deviation / mean [%]", fontsize=SMALL)
    right.legend(fontsize=SMALL)
    for axes in (left, right):
        tidy(axes)
    worst = list(columns)[int(np.nanargmax(np.nan_to_num(scatter, nan=-1.0)))]
    met = (
        "all estimates meet the paper's rule of 30 %"
        if found.consistent
        else "not all estimates meet the paper's rule of 30 %"
    )
    title(figure, f"{worst} scatters most over the experiments; {met}")
    return figure
