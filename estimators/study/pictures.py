"""The pictures that suit a study."""

from collections.abc import Callable
from typing import Any

import numpy as np

from estimators.study.kept import Kept
from estimators.study.statistics import summary


def plot(results: Kept, which: str | None = None) -> Any:
    """Return one picture: "estimates", "coverage", "pairs", "confusion" or "envelopes"; by default the first that suits the study.

    Raises:
        ValueError: the study has no such picture.
    """
    known = _pictures(results)
    if not known or (which is not None and which not in known):
        raise ValueError(f"there is no picture {which!r} of this study; there are {', '.join(known) or 'none'}.")
    draw, _ = known[which or next(iter(known))]
    return draw(results)


def figures(results: Kept) -> dict[str, tuple[Any, str]]:
    """Return every picture that suits the study, with a caption."""
    return {name: (draw(results), caption) for name, (draw, caption) in _pictures(results).items()}


def _pictures(results: Kept) -> dict[str, tuple[Callable[..., Any], str]]:
    from estimators.plots.study import plot_confusions, plot_coverage, plot_envelopes, plot_estimates, plot_pairs

    methods = {one.method for one in results.spec.estimate}
    suits = {
        "estimates": results.has_estimates,
        "coverage": bool(np.any(np.isfinite(summary(results)["coverage"].values))),
        "pairs": results.has_estimates,
        "confusion": "diagnosis" in methods and len(results.index) > 0,
        "envelopes": "quantities" in results.arrays
        and "envelope" in methods
        and bool(np.any(np.isfinite(results.arrays["quantities"]))),
    }
    pictures: dict[str, tuple[Callable[..., Any], str]] = {
        "estimates": (
            plot_estimates,
            "Error of every estimate in percent of the truth: bars are the repetitions, the line is the normal density with "
            "the stated standard deviation.",
        ),
        "coverage": (
            plot_coverage,
            "How often the stated 95 % interval holds the truth, with the 95 % interval of Clopper and Pearson.",
        ),
        "pairs": (
            plot_pairs,
            "Errors of two estimates of one repetition against each other, by the last estimator.",
        ),
        "confusion": (
            plot_confusions,
            "Rows: what was hidden. Columns: what was named; of a group that the data cannot tell apart the hidden "
            "effect counts.",
        ),
        "envelopes": (plot_envelopes, "Each point is one envelope; above the line it holds what it states."),
    }
    return {name: picture for name, picture in pictures.items() if suits[name]}
