"""Confusion between candidates that look alike in these data."""

import numpy as np

from estimators.diagnosis.candidate import Candidate
from estimators.diagnosis.diagnosis import Diagnosis
from estimators.diagnosis.ranking import ranked
from estimators.plots.style import SMALL, Picture, picture, title

_MOST = 12
_FEWEST = 3
_ALIKE = 0.9  # correlation from which on two effects are hard to tell apart
_LABEL = "Largest correlation of what two effects change [1]"


def plot_confusion(diagnosis: Diagnosis) -> Picture:
    """Draw the correlation between what the candidates would change, as a heat map.

    Shown are the testable ones with a positive score; where these are fewer than three, the best twelve.
    """
    shown = confusable(diagnosis)
    names = [c.id for c in shown]
    values = np.array([[_between(a, b) for b in shown] for a in shown])
    values = values.reshape(len(shown), len(shown))
    figure = picture(7.4, 5.2)
    axes = figure.subplots()
    if not shown:
        axes.set_xticks([])
        axes.set_yticks([])
        axes.set_xlabel(_LABEL, fontsize=SMALL)
        axes.text(0.5, 0.5, "no candidate that these data could show", ha="center", fontsize=SMALL)
        title(figure, _finding(shown, values, set()))
        return figure
    image = axes.imshow(values, cmap="Greys", vmin=0.0, vmax=1.0)
    accepted = {c.id for c in diagnosis.effects}
    labels = [f"★ {name}" if name in accepted else name for name in names]
    axes.set_xticks(range(len(names)), labels, rotation=35, ha="right", rotation_mode="anchor", fontsize=SMALL)
    axes.set_yticks(range(len(names)), labels, fontsize=SMALL)
    for row, column in np.argwhere(values >= 0.3):
        if row != column:
            dark = values[row, column] > 0.6
            axes.text(
                column, row, f"{values[row, column]:.2f}", ha="center", va="center", fontsize=7,
                color="white" if dark else "black",
            )  # fmt: skip
    axes.tick_params(length=0)
    bar = figure.colorbar(image, ax=axes, shrink=0.8)
    bar.set_label(_LABEL, fontsize=SMALL)
    bar.ax.tick_params(labelsize=SMALL)
    title(figure, _finding(shown, values, accepted))
    return figure


def confusable(diagnosis: Diagnosis) -> list[Candidate]:
    """Return the candidates worth comparing, best first."""
    accepted = {c.id for c in diagnosis.effects}
    testable = [c for c in ranked(diagnosis) if c.testable or c.id in accepted]
    positive = [c for c in testable if c.score > 0 or c.id in accepted]
    return (positive if len(positive) >= _FEWEST else testable)[:_MOST]


def _between(a: Candidate, b: Candidate) -> float:
    return 1.0 if a.id == b.id else a.correlation.get(b.id, b.correlation.get(a.id, 0.0))


def _finding(shown: list[Candidate], values: np.ndarray, accepted: set[str]) -> str:
    if len(shown) < 2:
        return "There are no two candidates that these data could confuse"
    others = values - 2 * np.eye(len(shown))
    # Of the accepted ones that which is hardest to tell from another.
    first = max(
        (i for i, c in enumerate(shown) if c.id in accepted), key=lambda i: float(np.max(others[i])), default=None
    )
    row, column = (
        (first, int(np.argmax(others[first]))) if first is not None else divmod(int(np.argmax(others)), len(shown))
    )
    pair, alike = f"{shown[row].id} and {shown[column].id}", f"(correlation {values[row, column]:.2f})"
    if first is not None:
        if values[row, column] < _ALIKE:
            named = " or ".join(c.id for c in shown if c.id in accepted)
            several = f" to {shown[row].id}" if named != shown[row].id else ""
            return f"Nothing looks like {named} in these data; the nearest{several} is {shown[column].id} {alike}"
        said = f"{shown[column].id} looks much like {shown[row].id} in these data {alike}"
        other = shown[column]
        if other.id in accepted or not other.refitted:
            return said
        return f"{said}, but fitted they are told apart, by {shown[row].bic_gain - other.bic_gain:.0f} in BIC"
    if values[row, column] < _ALIKE:
        return f"No two of these candidates look alike in these data; the nearest are {pair} {alike}"
    return f"In these data {pair} look alike {alike}"
