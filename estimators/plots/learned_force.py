"""A learned force over its range, and that it is not known beyond."""

import numpy as np

from estimators.diagnosis.improvement import Improvement
from estimators.plots.improvement import finding
from estimators.plots.style import NAMES, SMALL, UNITS, Picture, picture, prefixed, tidy, title

_BEYOND = 0.15  # of the range, drawn on either side of it


def plot_learned_force(improvement: Improvement) -> Picture:
    """Draw the learned force with two standard deviations, and beyond its range the last value that it keeps there.

    Raises:
        ValueError: nothing was learned.
    """
    learned = improvement.learned
    if learned is None:
        raise ValueError("this improvement has no learned force to draw: its verdict is known, or none would help.")
    figure = picture(9.6, 3.8)
    axes = figure.add_subplot()
    across = prefixed(float(np.max(np.abs(learned.at))), UNITS[learned.variable])
    known = np.isfinite(learned.std)
    spread = np.where(known, 2 * learned.std, 0.0)
    up = prefixed(float(np.max(np.abs(learned.force) + spread)), learned.unit)
    at, force = across.factor * learned.at, up.factor * learned.force
    if known.all():
        axes.fill_between(
            at, force - up.factor * spread, force + up.factor * spread, color="0.82", linewidth=0, label="±2 std"
        )
    axes.plot(at, force, color="#08306b", marker="o", markersize=3, linewidth=1.4, label="learned")
    if not learned.variable.startswith("arm_angle"):  # which has no beyond
        width = _BEYOND * (at[-1] - at[0])
        for number, (end, value, sign) in enumerate(((at[0], force[0], -1), (at[-1], force[-1], 1))):
            axes.axvspan(*sorted((end, end + sign * width)), color="0.94", zorder=0)
            label = "not recorded: keeps its last value" if number == 0 else None
            axes.plot(
                [end, end + sign * width], [value, value], color="#08306b", linestyle=":", linewidth=1.4, label=label
            )
        axes.set_xlim(at[0] - width, at[-1] + width)
    axes.axhline(0, color="black", linewidth=0.6)
    name, what = NAMES[learned.variable], "torque" if learned.port == "arm" else "force"
    axes.set_xlabel(f"{name[0].upper()}{name[1:]} [{across.unit}]", fontsize=SMALL)
    axes.set_ylabel(f"Learned {what} on the {learned.port} [{up.unit}]", fontsize=SMALL)
    axes.set_title(
        f"learned from {at[0]:.3g} to {at[-1]:.3g} {across.unit}, as far as the model's own parameters do not explain it",
        fontsize=9, loc="left",
    )  # fmt: skip
    tidy(axes)
    axes.legend(fontsize=SMALL, loc="best")
    title(figure, finding(improvement))
    return figure
