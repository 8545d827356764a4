"""Profile likelihood of one parameter beside the parabola that its standard deviation stands for."""

import numpy as np
from scipy.stats import chi2

from estimators.inference.profile_likelihood import Profile
from estimators.plots.style import MODELS, SMALL, Picture, picture, prefixed, tidy, title


def plot_profile(found: Profile) -> Picture:
    """Draw the rise of twice the negative log-likelihood, with the interval of the level."""
    figure = picture(6.4, 4.0)
    axes = figure.subplots()
    scale = prefixed(float(np.max(np.abs(found.held))), found.unit)
    grid = np.linspace(found.held[0], found.held[-1], 200)
    axes.plot(
        scale.factor * grid, ((grid - found.value) / found.std) ** 2, label="from the standard deviation", **MODELS[0]
    )
    axes.plot(scale.factor * found.held, found.rise, "o", color=MODELS[1]["color"], label="all else fitted again")
    bound = float(chi2.ppf(found.level, 1))
    axes.axhline(bound, color="black", linestyle=":", linewidth=1, label=f"bound of {100 * found.level:.3g} %")
    for end in found.interval:
        if np.isfinite(end):
            axes.axvline(scale.factor * end, color="0.6", linewidth=0.8)
    axes.set_xlabel(f"{found.name} [{scale.unit}]", fontsize=SMALL)
    axes.set_ylabel("Rise of -2 log likelihood [1]", fontsize=SMALL)
    axes.legend(fontsize=SMALL)
    tidy(axes)
    low, high = found.interval
    title(figure, f"{found.name} lies between {low * scale.factor:.5g} and {high * scale.factor:.5g} {scale.unit}")
    return figure
