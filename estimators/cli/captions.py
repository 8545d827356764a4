"""Captions of the figures in the reports of `rtac`."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DIAGNOSIS = (
    "The bars: what every candidate gains on the one-step predictions of the base model, and from which size on it would "
    "have been found. The curves: the missing force as a function of what it may depend on, with two standard deviations, in "
    "which counts what the model's own parameters could take up, such as a slope. Where the effect that was found is such "
    "a force, its curve is drawn over it."
)
CONFUSION = (
    "How much alike the changes are that two effects would make in these data: from 0.9 on it takes another kind of "
    "experiment to tell them apart."
)
WHERE = (
    "Mean squared innovations of the base model in each part of the data, 1 where there is only noise. The darker, the further "
    "beyond what chance exceeds in one of a hundred; these are bold."
)
BANDS = "Error of free simulation by frequency, in units of white noise of the sensor in the same band."
LEARNED = (
    "The force that was learned as a last resort. It names no physics: it makes the error fall where it was learned, and is not "
    "known beyond. What the model's own parameters explain, such as a slope, is theirs."
)
LADDER = "Left: error of free simulation in units of the sensor noise. Right: the worst of the experiments held out."


def without_limits(explanation: str) -> str:
    """Return the explanation as far as the tables of a report do not say it better."""
    before, found, limits = explanation.partition(" An effect would have been found from: ")
    rest = limits.partition(". ")[2]
    table = " The table of candidates says from which size on each effect would have been found." if found else ""
    return f"{before}{table}{' ' if rest else ''}{rest}"


def shown(figures: "Mapping[str, Figure]", **captions: str) -> list[Any]:
    """Return figures with their captions, in the order of the captions; of what was not drawn none."""
    from estimators.reporting.html import Shown

    return [Shown(figures[name], caption) for name, caption in captions.items() if name in figures]
