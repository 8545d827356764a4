"""The parameters after a fit with all that is known of them: what `rtac fit` prints, and the tables of its report."""

import dataclasses

import numpy as np

from estimators.closed_form.table1 import ClosedForm
from estimators.core.fit import Fit
from estimators.inference.agreement import Agreement
from estimators.inference.robust_covariance import Covariances
from estimators.prediction_error.fit import PredictorFit
from estimators.reporting.html import Table
from estimators.validation.recommendation import RULE, Recommendation
from rtac_jax.overview import aligned


@dataclasses.dataclass(frozen=True)
class AllEstimates:
    """One recording's estimates by every estimator that was asked.

    Attributes:
        closed: in closed form.
        fit: output error.
        predicted: prediction error.
        agreed: all held against each other.
        spread: covariances of the fit that hold for a coloured residual.
        both_move: whether cart and arm of the rig move, as those of Table 1 do.
    """

    closed: ClosedForm
    fit: Fit
    predicted: PredictorFit | None = None
    agreed: Agreement | None = None
    spread: Covariances | None = None
    both_move: bool = True


def fit_table(known: AllEstimates) -> str:
    """Format closed form, output error and prediction error side by side, with standard deviations and differences.

    Returns:
        One table, the verdict, the combinations that the data determine worst, and Table 1 of the closed form where the whole rig
        moves.
    """
    rows, predicted, closed = _rows(known), known.predicted, known.closed
    parts = ["\n".join(aligned(rows, right=range(2, len(rows[0]))))]
    if predicted is not None:
        parts.append(
            f"Prediction error takes a random force of {predicted.force_noise:.3g} N/sqrt(Hz) on the cart and a random torque "
            f"of {predicted.torque_noise:.3g} N m/sqrt(Hz) on the arm into account."
        )
    if known.agreed is not None:
        parts.append(known.agreed.verdict)
    if weak := known.fit.information.weak_sentences():
        parts.append("\n".join(weak))
    if skipped := [f"The closed form could not use {name}: {why}" for name, why in closed.skipped.items()]:
        parts.append("\n".join(skipped))
    return "\n\n".join([*parts, f"Table 1 of these data\n{closed}"] if known.both_move else parts)


def estimates_table(known: AllEstimates) -> Table:
    """Return the same numbers as a table of a report, where every standard deviation says what it takes for granted."""
    header, *rows = _rows(known)
    names = iter((f"{_form(known)} std", "output error std", "prediction error std"))
    words = {
        "coloured": "output error std, coloured residual",
        "clustered": "output error std, independent experiments",
    }
    words |= {"sigmas apart": "sigmas apart [1]"}
    head = tuple(next(names) if word == "std" else words.get(word, word) for word in header)
    return Table(head, tuple(tuple(row) for row in rows), f"In the unit of each row. {RULE}")


def recommended_table(advice: Recommendation, fit: Fit) -> Table:
    """Return the estimates to use: one value and one standard deviation for each parameter."""
    rows = tuple(
        (name, f"{p.value:.6g}", "fixed" if p.is_fixed else _short(p.std), p.unit)
        for name, p in advice.parameters.items()
        if name not in fit.unexcited
    )
    return Table(("parameter", "recommended", "std", "unit"), rows, advice.sentence)


def _form(known: AllEstimates) -> str:
    return "weak form" if known.closed.options.weak else "closed form"


def _rows(known: AllEstimates) -> list[list[str]]:
    """Return all estimates with all standard deviations, one parameter a row, under a header."""
    fit, predicted, agreed, spread = known.fit, known.predicted, known.agreed, known.spread
    header = ["parameter", "unit", _form(known), "std", "output error", "std"]
    if spread is not None:
        header += ["coloured", "clustered"]
    if predicted is not None:
        header += ["prediction error", "std"]
    if agreed is not None:
        header += ["sigmas apart"]
    rows = [header]
    coloured = spread.std("sandwich") if spread is not None else {}
    by_cluster = spread.std("clustered") if spread is not None else {}
    apart = _apart(agreed, fit)
    for name, p in ((n, p) for n, p in fit.parameters.items() if n not in fit.unexcited):
        e = known.closed.estimates.get(name)
        row = [name, p.unit, *(("", "") if e is None else (f"{e.value:.6g}", _short(e.std))), f"{p.value:.6g}"]
        row.append("fixed" if p.is_fixed else _short(p.std))
        if spread is not None:
            row += [_short(coloured.get(name, np.nan)), _short(by_cluster.get(name, np.nan))]
        if predicted is not None:
            other = predicted.parameters[name]
            row += [f"{other.value:.6g}", "fixed" if other.is_fixed else _short(other.std)]
        if agreed is not None:
            row.append(f"{apart[name]:.1f}" if name in apart else "")
        rows.append(row)
    return rows


def _apart(agreed: Agreement | None, fit: Fit) -> dict[str, float]:
    """Return the largest difference of any two estimators, in its standard deviations."""
    if agreed is None:
        return {}
    sigmas = np.max([np.nan_to_num(np.abs(pair.difference / pair.std)) for pair in agreed.pairs], axis=0)
    return {n: float(s) for n, s in zip(agreed.names, sigmas, strict=True) if n in fit.information.names}


def _short(std: float) -> str:
    return f"{std:.2g}" if np.isfinite(std) else ""
