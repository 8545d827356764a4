"""The differences between estimates of the same physics, in their standard deviations."""

import numpy as np
from scipy.stats import t as student

from estimators.inference.agreement import Agreement
from estimators.plots.style import MARKERS, MODELS, NOISE, SMALL, Picture, picture, tidy, title


def plot_agreement(found: Agreement) -> Picture:
    """Draw the differences of every two estimators beside what chance allows."""
    figure = picture(8.4, 0.45 * len(found.names) + 2.0)
    axes = figure.subplots()
    places = np.arange(len(found.names))
    fraction = found.level / (len(found.names) * len(found.pairs))
    bound = float(student.isf(fraction / 2, found.draws - 1))
    axes.axvspan(-bound, bound, zorder=0, label=f"chance, at {100 * found.level:.3g} % for all together", **NOISE)
    axes.axvline(0, color="black", linewidth=0.8)
    farthest = bound
    for number, pair in enumerate(found.pairs):
        sigmas = pair.difference / pair.std
        farthest = max(farthest, float(np.nanmax(np.abs(sigmas))))
        shift = 0.16 * (number - 0.5 * (len(found.pairs) - 1))
        axes.plot(
            sigmas, places + shift, MARKERS[number % len(MARKERS)], color=MODELS[(number + 1) % len(MODELS)]["color"],
            label=f"{pair.labels[0]} less {pair.labels[1]}, p = {pair.p_value:.2g}",
        )  # fmt: skip
    if farthest > 5 * bound:
        axes.set_xscale("symlog", linthresh=bound)
    axes.set_yticks(places, found.names)
    axes.invert_yaxis()
    axes.set_xlabel("Difference / its standard deviation [1]", fontsize=SMALL)
    figure.legend(fontsize=SMALL, loc="outside lower center", ncols=2, frameon=False)
    tidy(axes)
    if found.rejected:
        title(figure, f"The estimates disagree, most clearly in {found.differing[0]}: the model lacks something")
    elif found.simulation is not None and found.simulation.vetoes:
        title(figure, f"No two estimates disagree, which confirms nothing. {found.simulation.headline}")
    elif found.doubted:
        title(
            figure,
            f"No two estimates disagree, but {' and '.join(found.worst.labels)} nearly do, which confirms nothing",
        )
    else:
        title(figure, "The estimates agree within chance")
    return figure
