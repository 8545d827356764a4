"""The pictures that suit a study."""

from typing import Any

import numpy as np

from estimators.core.drawing import draw
from estimators.study.kept import Kept
from estimators.study.statistics import summary
from estimators.study.truth import LINEARISED


def plot(results: Kept, which: str | None = None) -> Any:
    """Return one picture, by default the first that suits the study.

    Args:
        results: of the study.
        which: "estimates", "coverage", "pairs", "bode", "confusion" or "envelopes".

    Raises:
        ValueError: the study has no such picture.
    """
    known = _captions(results)
    if not known or (which is not None and which not in known):
        raise ValueError(f"there is no picture {which!r} of this study; there are {', '.join(known) or 'none'}.")
    return draw(results, which or next(iter(known)))


def figures(results: Kept) -> dict[str, tuple[Any, str]]:
    """Return every picture that suits the study, with a caption."""
    return {name: (draw(results, name), caption) for name, caption in _captions(results).items()}


def _captions(results: Kept) -> dict[str, str]:
    """Return the captions of the pictures that suit the study, by name; `estimators.plots` draws them by these names."""
    methods = {one.method for one in results.spec.estimate}
    suits = {
        "estimates": results.has_estimates,
        "coverage": bool(np.any(np.isfinite(summary(results)["coverage"].values))),
        "pairs": results.has_estimates,
        "bode": _physical(results),
        "confusion": "diagnosis" in methods and len(results.index) > 0,
        "envelopes": "quantities" in results.arrays
        and "envelope" in methods
        and bool(np.any(np.isfinite(results.arrays["quantities"]))),
    }
    captions = {
        "estimates": "Error of every estimate in percent of the truth: bars are the repetitions, the line is the normal density "
        "with the stated standard deviation.",
        "coverage": "How often the stated 95 % interval holds the truth, with the 95 % interval of Clopper and Pearson.",
        "pairs": "Errors of two estimates of one repetition against each other, by the last estimator.",
        "bode": "Response of small motions about theta = 0: of the truth, and 95 % of the repetitions' estimates over it.",
        "confusion": "Rows: what was hidden. Columns: what was named; of a group that the data cannot tell apart the hidden "
        "effect counts.",
        "envelopes": "Each point is one envelope; above the line it holds what it states.",
    }
    return {name: caption for name, caption in captions.items() if suits[name]}


def _physical(results: Kept) -> bool:
    """Return whether a parameter of the linearised model was estimated."""
    if not results.has_estimates:
        return False
    names = results.layout.coordinates["parameter"]
    asked = [p for p, name in enumerate(names) if name in LINEARISED]
    return bool(np.any(np.isfinite(results.arrays["estimate"][..., asked])))
