"""Maps of where the innovations of the base model are larger than they should be."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm

from estimators.diagnosis.diagnosis import Diagnosis
from estimators.misspecification.residual_maps import Place
from estimators.plots.style import NAMES, SMALL, UNITS, Picture, picture, prefixed, quantity, times, title

_MOST_EXPERIMENTS = 12
_DARK = 10.0  # times the bound of chance that are drawn black


def plot_where(diagnosis: Diagnosis) -> Picture:
    """Draw mean squared innovations by experiment, time, frequency and size of the motion: 1 is the noise.

    A cell is the darker the further its value lies beyond what chance exceeds in one of a hundred; these have bold numbers.

    Raises:
        ValueError: the diagnosis holds no innovations by part of the data.
    """
    if not diagnosis.places:
        raise ValueError("the diagnosis holds no innovations by part of the data; make it with est.diagnose.")
    kinds = list(dict.fromkeys(place.by for place in sorted(diagnosis.places, key=_order)))
    channels = [name for name in NAMES if any(place.channel == name for place in diagnosis.places)]
    below = [kind for kind in kinds if kind != "experiment"]
    figure = picture(9.6, 1.9 + 0.75 * len(channels))
    rows = figure.add_gridspec(2, 1, hspace=0.12)
    top = figure.add_subplot(rows[0])
    own, every = _experiments(diagnosis.places)
    _map(top, own, channels, "experiment", named=True)
    shown = len({place.label for place in own})
    which = f"worst {shown} of {every}; " if shown < every else ""
    top.set_xlabel(f"Experiment   ({which}numbers: mean squared innovation over that of the noise [1])", fontsize=SMALL)
    columns = rows[1].subgridspec(1, len(below))
    for column, kind in enumerate(below):
        own = [place for place in diagnosis.places if place.by == kind]
        _map(figure.add_subplot(columns[column]), own, channels, kind, named=column == 0)
    title(figure, _finding(diagnosis))
    return figure


def _order(place: Place) -> int:
    """Return the place of a panel in their order; the places themselves are sorted worst first."""
    return ["experiment", "time", "frequency", *NAMES].index(place.by)


def _experiments(places: Sequence[Place]) -> tuple[list[Place], int]:
    """Return the worst of many experiments, and how many there are."""
    own = [place for place in places if place.by == "experiment"]
    names = list(dict.fromkeys(place.label for place in own))
    return [place for place in own if place.label in names[:_MOST_EXPERIMENTS]], len(names)


def _map(axes: Axes, places: Sequence[Place], channels: list[str], kind: str, *, named: bool) -> None:
    labels = list(dict.fromkeys(place.label for place in sorted(places, key=lambda place: place.part)))
    excess = np.full((len(channels), len(labels)), np.nan)
    for place in places:
        excess[channels.index(place.channel), labels.index(place.label)] = place.excess
    axes.imshow(excess, cmap="Greys", norm=LogNorm(1.0, _DARK, clip=True), aspect="auto")
    for place in places:
        axes.text(
            labels.index(place.label), channels.index(place.channel), times(place.value), ha="center", va="center",
            fontsize=7.5, fontweight="bold" if place.excess > 1 else "normal",
            color="white" if place.excess > np.sqrt(_DARK) else "black",
        )  # fmt: skip
    sizes = [_sizes(label) for label in labels] if kind in UNITS else []
    scale = prefixed(max((high for _, high in sizes), default=1.0), UNITS.get(kind, "1"))
    shown = [_between(*(scale.factor * size for size in pair)) for pair in sizes] or [_short(label) for label in labels]
    axes.set_xticks(range(len(labels)), shown, fontsize=7)
    if kind == "experiment":
        axes.tick_params(axis="x", rotation=0 if len(labels) < 7 else 20)
    axes.set_yticks(range(len(channels)), [NAMES[c] for c in channels] if named else [], fontsize=SMALL)
    axes.tick_params(length=0)
    axes.grid(False)
    what = {"experiment": "", "time": "Quarter of each experiment [1]", "frequency": "Frequency [rad/s]"}
    axes.set_xlabel(what[kind] if kind in what else f"Size of the {NAMES[kind]} [{scale.unit}]", fontsize=SMALL)


def _sizes(label: str) -> tuple[float, float]:
    """Return the sizes of a motion between which a part lies, from its label."""
    low, high = label.split("| ")[-1].split(" to ")
    return float(low), float(high)


def _between(low: float, high: float) -> str:
    return f"{low if low > 0.01 * high else 0.0:.3g}\nto {high:.3g}"


def _short(label: str) -> str:
    """Return a part's name by what tells it from the others of its kind, which the axis names."""
    if label.startswith("quarter"):
        return label.split()[1]
    return label.removesuffix(" rad/s").replace(" to ", "\nto ")


def _finding(diagnosis: Diagnosis) -> str:
    worst = max(diagnosis.places, key=lambda place: place.excess)
    if worst.excess <= 1:
        return "The innovations are as large as the noise in every part of the data"
    # One part in a hundred is beyond its bound by chance.
    if diagnosis.verdict == "adequate":
        return (
            f"No part of the data speaks against the model: {times(worst.value)} times the power of the noise at most"
        )
    part = {
        "experiment": f"in {worst.label}",
        "time": f"in the {worst.label}",
        "frequency": f"at {worst.label}",
    }.get(worst.by)
    if part is None:
        low, high = (quantity(size, UNITS[worst.by]) for size in _sizes(worst.label))
        part = f"where the {NAMES[worst.by]} is {low} to {high} in size"
    return (
        f"The model fails most in {NAMES[worst.channel]} {part}: "
        f"the mean squared innovation is {times(worst.value)} times that of the noise"
    )
