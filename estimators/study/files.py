"""Results of a study as files: CSV, and a report of one HTML file."""

import csv
import io
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from estimators.reporting.html import Shown, Table, versions, write_bytes, write_figures, write_report
from estimators.study.confusion import naming
from estimators.study.kept import Kept
from estimators.study.pictures import figures
from estimators.study.statistics import summary
from estimators.study.tables import said, table


def to_csv(results: Kept, path: str | os.PathLike[str]) -> None:
    """Write the summary: one row for each estimator and parameter."""
    found = summary(results)
    rows: list[list[Any]] = [["estimator", "parameter", *found]]
    for e, estimator in enumerate(results.estimators):
        for p, parameter in enumerate(results.layout.coordinates["parameter"]):
            if found["count"].values[e, p]:
                rows.append([estimator, parameter, *(float(one.values[e, p]) for one in found.values())])
    _write_csv(path, rows)


def repetitions_to_csv(results: Kept, path: str | os.PathLike[str]) -> None:
    """Write every repetition: one row for each of its estimators, failed ones with their reasons."""
    columns: list[tuple[str, Mapping[str, Any]]] = []
    names = results.layout.coordinates
    header = ["repetition", "hidden", "excitation", "estimator", "verdict", "named", "reason"]
    for variable in ("truth", "estimate", "std", "quantities"):
        if variable in results.arrays:
            axis = "quantity" if variable == "quantities" else "parameter"
            columns.append((variable, dict(enumerate(names[axis]))))  # type: ignore[arg-type] - keys are places
            header += [name if axis == "quantity" else f"{variable} of {name}" for name in names[axis]]
    rows: list[list[Any]] = [header]
    for r, index in enumerate(results.index):
        for e, estimator in enumerate(results.estimators):
            row = [int(index), results.arrays["hidden"][r], results.arrays["excitation"][r], estimator]
            row += [results.arrays[name][r, e] for name in ("verdict", "named", "reason")]
            for variable, _ in columns:
                row += [
                    float(x)
                    for x in (results.arrays[variable][r] if variable == "truth" else results.arrays[variable][r, e])
                ]
            rows.append(row)
    _write_csv(path, rows)


def report(results: Kept, folder: str | os.PathLike[str]) -> Path:
    """Write figures, CSV files and a report of one HTML file into a folder; gives the report's path."""
    place = Path(folder)
    place.mkdir(parents=True, exist_ok=True)
    drawn = figures(results) if len(results.index) else {}
    images = write_figures(place, {name: figure for name, (figure, _) in drawn.items()})
    if results.has_estimates:
        to_csv(results, place / "summary.csv")
    repetitions_to_csv(results, place / "repetitions.csv")
    tables = [table(results)] if results.has_estimates else []
    if "confusion" in drawn:
        tables.append(naming(results))
    tables += [one for one in (table(results, "quantities"), table(results, "failures")) if one.rows]
    settings = Table(("setting", "value"), (("study", results.spec.name), ("hash", results.spec.digest)))
    sections: list[Any] = [
        ("Result", [part for part in (results.spec.question, *said(results)) if part]),
        ("Figures", [Shown(figure, caption) for figure, caption in drawn.values()]),
        ("Tables", tables),
        ("The study", [*(line for line in results.spec.to_toml().splitlines() if line)]),
        ("Settings and versions", [settings, versions()]),
    ]
    write_report(place / "report.html", f"Study: {results.spec.name}", sections, images=images)
    return place / "report.html"


def _write_csv(path: str | os.PathLike[str], rows: list[list[Any]]) -> None:
    made = io.StringIO()
    csv.writer(made, lineterminator="\n").writerows(rows)
    write_bytes(path, made.getvalue().encode())
