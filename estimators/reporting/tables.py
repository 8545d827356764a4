"""Results as tables, for the screen and for a report's page."""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from estimators.core.fit import Fit, Parameter
from estimators.diagnosis.diagnosis import Diagnosis
from estimators.diagnosis.policy import DiagnosisPolicy
from estimators.diagnosis.ranking import ranked
from estimators.prediction_error.fit import PredictorFit
from estimators.reporting.html import Table
from estimators.validation.simulation_error import Comparison
from estimators.validation.trace import colour_of
from rtac_jax.measurement import OUTPUTS


def every_parameter(fit: Fit | PredictorFit) -> dict[str, Parameter]:
    """Return the shared parameters, and those that each experiment has for itself as NAME[EXPERIMENT]."""
    return fit.parameters | fit.each_parameters


def error_table(train: Comparison, validation: Comparison | None) -> Table:
    """Return a table of the error of every channel before and after, for both sides of the split."""
    rows = []
    two = len(train.models) > 1
    for which, comparison in (("train", train), ("validation", validation)):
        if comparison is None:
            continue
        before, after = comparison.models[0].errors, comparison.models[-1].errors
        for channel, error in before.items():
            row = [
                which,
                f"{channel} [{OUTPUTS[channel]}]",
                f"{error.fit_percent:.2f}",
                f"{error.rms:.3g}",
                f"{error.rms_over_noise:.2f}",
            ]
            if two:
                then = after[channel]
                row += [f"{then.fit_percent:.2f}", f"{then.rms:.3g}", f"{then.rms_over_noise:.2f}"]
            rows.append(tuple(row))
    header = ["data", "channel [unit]", "fit [%]", "rms [unit]", "rms/noise [1]"]
    header += ["fit after [%]", "rms after [unit]", "rms/noise after [1]"] if two else []
    what = "free simulation" if train.ahead is None else f"predictions {train.ahead} sample(s) ahead"
    lost = " ".join(c.divergence for c in (train, validation) if c is not None and c.divergence)
    return Table(tuple(header), tuple(rows), f"Error of {what}; the noise is that of the sensor. {lost}".rstrip())


def parameter_table(
    fit: Fit | PredictorFit, *, base: Fit | None = None, estimates: Mapping[str, Parameter] | None = None
) -> Table:
    """Return a table of parameters with standard deviations; with a base fit its values before them.

    Args:
        fit: of the last model.
        base: of the first one.
        estimates: parameters with other standard deviations than those for a white residual.
    """
    rows = []
    known, bounds = every_parameter(base) if base is not None else {}, fit.on_bounds()
    idle = {f"{effect.id}.{name}" for effect in fit.model.effects for name in effect.idle}
    for name, p in (every_parameter(fit) | dict(estimates or {})).items():
        if name in idle or name in fit.unexcited:
            continue
        std = "" if math.isnan(p.std) else "fixed" if p.is_fixed else f"{p.std:.2g}"
        std += ", on its bound" if name in bounds else ""
        row = [name, f"{p.value:.6g}", std, p.unit]
        if base is not None:
            row.insert(1, f"{known[name].value:.6g}" if name in known else "")
        rows.append(tuple(row))
    header = (
        ("parameter", "before", "value", "std", "unit") if base is not None else ("parameter", "value", "std", "unit")
    )
    return Table(header, tuple(rows))


def comparison_table(rows: Sequence[Mapping[str, Any]], *, whiteness: bool = True) -> Table:
    """Return a table of the error of every channel of every experiment, as `comparison_rows` gives it.

    Args:
        rows: one for each.
        whiteness: show whether each residual is white.
    """
    header = ("experiment", "channel [unit]", "fit [%]", "rms [unit]", "rms/noise [1]", *("residual",) * whiteness)
    return Table(
        header,
        tuple(
            (
                row["experiment"],
                f"{row['channel']} [{OUTPUTS[row['channel']]}]",
                "" if row["fit_percent"] is None else f"{row['fit_percent']:.2f}",
                f"{row['rms']:.3g}",
                f"{row['rms_over_noise']:.2f}",
                *(colour_of(row["whiteness_p"]),) * whiteness,
            )
            for row in rows
        ),
    )


def evidence_table(diagnosis: Diagnosis) -> Table:
    """Return a table of the tests of whether anything is missing, before and after what was added."""
    after = {test.test: test for test in diagnosis.left} if diagnosis.additions else {}
    rows = []
    for test in diagnosis.tests:
        row = [test.test, f"{test.p_value:.2g}", "rejects" if test.rejects else "passes", test.words]
        if diagnosis.additions:
            then = after.get(test.test)
            row[3:3] = [""] if then is None else [f"{'rejects' if then.rejects else 'passes'} (p {then.p_value:.2g})"]
        rows.append(tuple(row))
    header = ["test", "p [1]", "base model", "in words"]
    if diagnosis.additions:
        header.insert(3, "with what was added")
    return Table(
        tuple(header), tuple(rows), "Is anything missing? All tests together reject one right model in a hundred."
    )


def policy_table(policy: DiagnosisPolicy) -> Table:
    """Return a table of the thresholds by which a diagnosis judged."""
    rows = [(name, f"{value:g}", meaning, source) for name, value, meaning, source in policy.rows()]
    return Table(("threshold", "value", "meaning", "source"), tuple(rows), policy.words)


def place_table(diagnosis: Diagnosis, most: int = 8) -> Table:
    """Return a table of the parts of the data where the innovations of the base model are too large."""
    rows = [
        (p.by, p.label, p.channel, f"{p.value:.2f}", f"{p.high:.2f}") for p in diagnosis.places[:most] if p.excess > 1
    ]
    header = ("by", "part", "channel", "mean square / noise variance [1]", "99 % bound [1]")
    return Table(header, tuple(rows), "Squared innovations where they exceed what chance allows, worst first.")


def _fate(named: bool, kept: bool) -> str:
    if named:
        return "accepted" if kept else "not kept"
    return "added later" if kept else ""


def candidate_table(diagnosis: Diagnosis, added: Collection[str] | None = None) -> Table:
    """Return a table of the candidates: what was accepted, then the others by their score, and below what nothing could show.

    Args:
        diagnosis: that tried them.
        added: ids of what a loop added in the end; by default what the diagnosis names is accepted.
    """
    named = {c.id for c in diagnosis.effects}
    kept = named if added is None else set(added)
    rows, silent = [], []
    for c in ranked(diagnosis):
        large = c.chi_square >= diagnosis.policy.alarm
        if not (c.can_show or c.refitted or large or c.id in named or c.id in kept):
            silent.append(c.id)
            continue
        rows.append(
            (
                c.id,
                f"{c.score:.1f}",
                f"{c.p_value:.2g}",
                f"{c.bic_gain:.1f}" if c.refitted else "",
                f"{100 * c.error_reduction:.0f}" if c.refitted else "",
                "large, not confirmed" if large and not c.can_show else c.limit_or_why,
                _fate(c.id in named, c.id in kept),
            )
        )
    header = ("effect", "score [1]", "p [1]", "BIC gain [1]", "explains [%]", "would be found from", "")
    return Table(
        header,
        tuple(rows),
        "Score: chi-square gained on the one-step predictions, less the price of the parameters. Those that came nearest were "
        "fitted, which gives BIC gain and fraction of the misfit.",
        f"Not testable with these data beside the model that was diagnosed: {', '.join(silent)}." if silent else "",
    )
