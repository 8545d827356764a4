"""The confusion of a study's diagnoses: named effects beside hidden ones."""

import collections

import numpy as np

from estimators.reporting.html import Table
from estimators.study.kept import Kept
from estimators.study.naming import outcome


def naming(results: Kept, estimator: str | None = None) -> Table:
    """Return what diagnoses named, beside what was hidden; one row for each hidden effect and excitation.

    Raises:
        ValueError: the study made no diagnosis.
    """
    column = _column_of(results, estimator)
    rows = []
    words = ("right", "right and more", "in the group", "a part", "unknown", "adequate", "wrong", "failed")
    for excitation in dict.fromkeys(results.arrays["excitation"]):
        for hidden in dict.fromkeys(results.arrays["hidden"]):
            here = np.flatnonzero((results.arrays["hidden"] == hidden) & (results.arrays["excitation"] == excitation))
            if not len(here):
                continue
            counts = collections.Counter(_outcome(results, row, column) for row in here)
            wrong = {str(results.arrays["named"][r, column]) for r in here if _outcome(results, r, column) == "wrong"}
            cells = [str(counts[word]) if counts[word] else "" for word in words]
            rows.append((str(hidden), str(excitation), *cells, "; ".join(sorted(wrong))))
    return Table(("hidden", "excitation", *words, "named instead"), tuple(rows), "Numbers of repetitions.")


def fractions(results: Kept, estimator: str | None = None) -> tuple[tuple[str, ...], tuple[str, ...], np.ndarray]:
    """Hidden effects, what was named, and the fraction of repetitions with each pair.

    Of effects that the data cannot tell apart the hidden one counts as named; what names nothing counts by its verdict.

    Raises:
        ValueError: the study made no diagnosis.
    """
    column = _column_of(results, estimator)
    hidden = tuple(dict.fromkeys(str(h) for h in results.arrays["hidden"]))
    counts: dict[tuple[str, str], float] = collections.defaultdict(float)
    for row, true in enumerate(results.arrays["hidden"]):
        for name in _named(results, row, column):
            counts[str(true), name] += 1.0
    others = sorted({name for _, name in counts} - set(hidden) - {"adequate", "unknown", "failed"})
    last = [word for word in ("adequate", "unknown", "failed") if any(name == word for _, name in counts)]
    named = (*(h for h in hidden if h != "nothing"), *others, *last)
    totals = collections.Counter(str(h) for h in results.arrays["hidden"])
    return hidden, named, np.array([[counts[h, n] / totals[h] for n in named] for h in hidden])


def _column_of(results: Kept, estimator: str | None) -> int:
    names = [one.name for one in results.spec.estimate if one.method == "diagnosis"]
    if not names:
        raise ValueError("this study made no diagnosis.")
    return results.estimators.index(estimator or names[0])


def _outcome(results: Kept, row: int | np.integer, column: int) -> str:
    if results.arrays["reason"][row, column]:
        return "failed"
    return outcome(
        str(results.arrays["hidden"][row]),
        str(results.arrays["verdict"][row, column]),
        str(results.arrays["named"][row, column]),
    )


def _named(results: Kept, row: int, column: int) -> list[str]:
    if results.arrays["reason"][row, column]:
        return ["failed"]
    text = str(results.arrays["named"][row, column])
    if not text:
        return [str(results.arrays["verdict"][row, column])]
    true = str(results.arrays["hidden"][row]).split(" + ")
    groups = [group.split("|") for group in text.split(" + ")]
    return [next((name for name in group if name in true), group[0]) for group in groups]
