"""Results of a study as tables and sentences."""

from typing import Any, Literal

import numpy as np

from estimators.reporting.html import Table
from estimators.study.confusion import naming
from estimators.study.kept import Kept
from estimators.study.statistics import envelope_coverage, quantities, summary

Subject = Literal["parameters", "quantities", "failures"]


def table(results: Kept, of: Subject = "parameters") -> Table:
    """Return the table of parameters, of other quantities, or of failures."""
    return {"parameters": _parameters, "quantities": _quantities, "failures": _failures}[of](results)


def _parameters(results: Kept) -> Table:
    """Return bias, scatter and coverage by estimator and parameter, in percent of the true value."""
    found = summary(results)
    rows = []
    for e, estimator in enumerate(results.estimators):
        for p, parameter in enumerate(results.layout.coordinates["parameter"]):
            at = {name: float(one.values[e, p]) for name, one in found.items()}
            if not at["count"]:
                continue
            size = abs(at["truth"]) or 1.0
            covered = (
                f"{100 * at['coverage']:.1f} ({100 * at['coverage_low']:.1f} to {100 * at['coverage_high']:.1f})"
                if np.isfinite(at["coverage"])
                else ""
            )
            numbers = (
                f"{100 * at[n] / size:.3g}" if np.isfinite(at[n]) else ""
                for n in ("bias", "std", "rms_error", "stated_std")
            )
            consistency = f"{100 * at['consistency']:.1f}" if np.isfinite(at["consistency"]) else ""
            rows.append((estimator, parameter, f"{at['truth']:.4g}", *numbers, covered, consistency))
    header = ("estimator", "parameter", "truth", "bias [%]", "std found [%]", "rms error [%]", "std stated [%]",
              "95 % intervals cover [%]", "consistency [%]")  # fmt: skip
    return Table(
        header,
        tuple(rows),
        "Coverage with its own 95 % interval; consistency: scatter over experiments, as Table 1.",
    )


def _failures(results: Kept) -> Table:
    """Return why repetitions failed."""
    rows = [(name, str(count), reason) for name, each in results.failures.items() for reason, count in each.items()]
    return Table(("estimator", "repetitions", "reason"), tuple(rows))


def _quantities(results: Kept) -> Table:
    """Return mean and scatter of what methods give besides parameters."""
    found = quantities(results)
    rows = []
    if found:
        mean, std = found["mean"].values, found["std"].values
        for e, q in np.argwhere(np.isfinite(mean)):
            names = results.estimators[e], results.layout.coordinates["quantity"][q]
            rows.append((*names, f"{mean[e, q]:.4g}", f"{std[e, q]:.2g}"))
    return Table(("estimator", "quantity", "mean", "std"), tuple(rows))


def ending(results: Kept) -> str:
    """Return how much of the study is finished, and how often it failed."""
    failed = ", ".join(f"{name} failed in {sum(each.values())}" for name, each in results.failures.items() if each)
    return f"{len(results.index)} of {results.spec.repetitions} repetitions; {failed or 'none failed'}."


def said(results: Kept) -> list[str]:
    """Return what the study found, in sentences."""
    sentences = [ending(results)]
    if any(one.method == "envelope" for one in results.spec.estimate) and len(results.index):
        try:
            c = envelope_coverage(results)
        except ValueError as error:
            return [*sentences, str(error)]
        sentences.append(
            f"An envelope states that with {100 * c['confidence']:.0f} % confidence a new condition lies inside with a "
            f"probability of at least {100 * c['stated']:.1f} % on average; of new conditions {100 * c['inside']:.1f} % do. "
            f"The stated fraction lay inside {100 * c['kept']:.1f} % of the envelopes (95 % interval "
            f"{100 * c['kept_low']:.1f} to {100 * c['kept_high']:.1f} %)."
        )
    return sentences


def text(results: Kept) -> str:
    """Return all that a study found, as a terminal shows it."""
    blocks: list[Any] = [f"{results.spec.name}: {results.spec.question}".removesuffix(": "), *said(results)]
    if results.has_estimates:
        blocks.append(table(results))
    if any(one.method == "diagnosis" for one in results.spec.estimate) and len(results.index):
        blocks.append(naming(results))
    blocks += [table for table in (_quantities(results), _failures(results)) if table.rows]
    return "\n\n".join(str(block) for block in blocks)
