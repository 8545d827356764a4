"""The two-sigma ellipses of every two parameters, and their correlations."""

import numpy as np

from estimators.core.parameter_correlation import ParameterCorrelations
from estimators.plots.style import SMALL, Picture, picture, title

_MOST = 10  # parameters beyond which ellipses are too small to be read
_CELL = 1.25  # inches of one pair


def plot_correlations(found: ParameterCorrelations) -> Picture:
    """Draw ellipses of two standard deviations below the diagonal and correlations above it.

    Of many parameters those are shown that are correlated most.
    """
    reach = np.max(np.abs(found.matrix - np.eye(len(found.names))), axis=1, initial=0.0)
    shown = np.sort(np.argsort(-reach, kind="stable")[:_MOST])
    count = len(shown)
    figure = picture(max(6.0, 1.2 + _CELL * count), 1.4 + _CELL * count)
    grid = figure.subplots(count, count, squeeze=False)
    for i, row in enumerate(shown):
        for j, column in enumerate(shown):
            axes = grid[i, j]
            axes.set_xticks([])
            axes.set_yticks([])
            if i > j:
                first, second = found.names[column], found.names[row]
                x, y = found.ellipse(first, second) - found.values[[column, row]][:, None]
                axes.plot(x / found.std[column], y / found.std[row], color="#08306b", linewidth=1.1)
                axes.plot(0, 0, "+", color="#e6550d", markersize=4)
                axes.set_xlim(-2.6, 2.6)
                axes.set_ylim(-2.6, 2.6)
            elif i < j:
                value = found.matrix[row, column]
                axes.set_facecolor((1.0, 1.0 - 0.5 * abs(value), 1.0 - 0.8 * abs(value)))
                axes.text(0.5, 0.5, f"{value:.2f}", transform=axes.transAxes, ha="center", va="center", fontsize=10)
            else:
                words = found.names[row].replace(".", ".\n").replace("_", "\n")
                spread = f"±{found.std[row]:.2g} {found.units[row]}"
                axes.text(
                    0.5, 0.5, f"{words}\n{spread}", transform=axes.transAxes, ha="center", va="center", fontsize=7
                )
                axes.set_facecolor("0.95")
            if i == count - 1 and j < i:
                axes.set_xlabel(f"{_short(found.names[column])} [std]", fontsize=7)
            if j == 0 and i > 0:
                axes.set_ylabel(f"{_short(found.names[row])} [std]", fontsize=7)
    some = (
        "" if count == len(found.names) else f"; the {count} of {len(found.names)} parameters that are correlated most"
    )
    figure.supxlabel(f"below: ellipses of 2 std [1]; above: correlations [1]{some}", fontsize=SMALL)
    title(figure, found.verdict)
    return figure


def _short(name: str) -> str:
    """Return a name that fits beside one cell."""
    return name.replace("_", "\n", 1).replace(".", "\n")
