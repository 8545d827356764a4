"""Results as JSON and as one HTML file that needs nothing else."""

import base64
import dataclasses
import html
import importlib.metadata
import json
import math
import os
import platform
import secrets
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from estimators._candidate import Candidate
from estimators._compare import Compared, Comparison
from estimators._diagnose import Diagnosis
from estimators._improve import Improvement
from estimators._least_squares import ClosedForm
from estimators._output_error import Fit, Parameter

FORMAT, VERSION = "rtac-report", 1
_PACKAGES = ("rtac-jax", "jax", "optimistix", "numpy", "scipy", "matplotlib")

# -- dictionaries ----------------------------------------------------------------------------------------------------


def report_dict(
    found: Diagnosis | Improvement,
    *,
    fit: Fit | None = None,
    train: Comparison | None = None,
    validation: Comparison | None = None,
    seconds: float | None = None,
) -> dict[str, Any]:
    """What a diagnosis or an improvement found, ready for `write_json`.

    Args:
        fit: whose parameters to give; of an improvement by default the last one.
        train, validation: the base model and, after it, the model with the effect; an improvement brings its own.
        seconds: how long everything took; by default what the result says of itself.
    """
    if isinstance(found, Improvement):
        fit = fit or found.final
        train, validation = train or found.train, validation or found.validation
        first = found.diagnoses[0]
        effects = [_effect(candidate, found.final) for candidate in found.added]
    else:
        first = found
        effects = [_effect(candidate, None) for candidate in found.effects]
    accepted = {effect["id"] for effect in effects}
    return _clean(
        {
            "format": FORMAT,
            "version": VERSION,
            "verdict": found.verdict,
            "effects": effects,
            "candidates": [_candidate(c, c.id in accepted) for c in first.candidates],
            "parameters": _parameters(fit.parameters) if fit is not None else {},
            "error": {"train": _before_after(train), "validation": _before_after(validation)},
            "next_experiment": None,
            "seconds": found.seconds if seconds is None else seconds,
        }
    )


def fit_dict(
    fit: Fit, *, train: Comparison, validation: Comparison | None, seconds: float, closed: ClosedForm | None = None
) -> dict[str, Any]:
    """The parameters and errors of a fit, with the closed form beside it where there is one."""
    found: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "parameters": _parameters(fit.parameters),
        "error": {"train": _before_after(train), "validation": _before_after(validation)},
        "seconds": seconds,
    }
    if closed is not None:
        found["closed_form"] = {
            name: {"value": e.value, "std": e.std, "unit": e.unit} for name, e in closed.estimates.items()
        }
    return _clean(found)


def comparison_rows(comparison: Comparison) -> list[dict[str, Any]]:
    """Error of every channel of every experiment, worst first."""
    return _clean(
        [
            {
                "model": compared.label,
                "experiment": t.experiment,
                "channel": t.channel,
                "fit_percent": t.fit_percent,
                "rms": t.rms,
                "rms_over_noise": t.rms / t.noise,
                "whiteness_p": t.whiteness_p,
            }
            for compared in comparison.models
            for t in compared.worst(len(compared.traces))
        ]
    )


def _effect(candidate: Candidate, final: Fit | None) -> dict[str, Any]:
    parameters = dict(candidate.parameters)
    if final is not None:  # the last fit knows them best
        known = final.parameters
        parameters = {name: known.get(f"{candidate.id}.{name}", found) for name, found in parameters.items()}
    return {
        "id": candidate.id,
        "score": candidate.score,
        "p_value": candidate.p_value,
        "error_reduction": candidate.error_reduction,
        "confusable_with": list(candidate.confusable_with),
        "parameters": _parameters(parameters),
    }


def _candidate(c: Candidate, accepted: bool) -> dict[str, Any]:
    return {
        "id": c.id,
        "p_value": c.p_value,
        "detection_limit": c.detection_limit,
        "testable": c.testable,
        "score": c.score,
        "unit": c.unit,
        "refitted": c.refitted,
        "bic_gain": c.bic_gain if c.refitted else None,
        "error_reduction": c.error_reduction if c.refitted else None,
        "accepted": accepted,
    }


def _parameters(parameters: Mapping[str, Parameter]) -> dict[str, Any]:
    return {name: {"value": p.value, "std": p.std, "unit": p.unit} for name, p in parameters.items()}


def _before_after(comparison: Comparison | None) -> dict[str, Any] | None:
    if comparison is None:
        return None
    first, *later = comparison.models
    return {"before": _errors(first), "after": _errors(later[-1]) if later else None}


def _errors(compared: Compared) -> dict[str, Any]:
    return {channel: dataclasses.asdict(error) for channel, error in compared.errors.items()}


def _clean(value: Any) -> Any:
    """Only what JSON knows: it has neither NaN nor infinity, and no arrays."""
    if isinstance(value, Mapping):
        return {str(key): _clean(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_clean(part) for part in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value


# -- tables ----------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Table:
    """Rows of text under a header; columns of numbers are set to the right."""

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""

    def __str__(self) -> str:
        widths = [max(len(row[i]) for row in (self.header, *self.rows)) for i in range(len(self.header))]
        lines = []
        for row in (self.header, *self.rows):
            cells = [
                cell.rjust(width) if self.numeric(i) else cell.ljust(width)
                for i, (cell, width) in enumerate(zip(row, widths, strict=True))
            ]
            lines.append("  ".join(cells).rstrip())
        return "\n".join(lines)

    def numeric(self, column: int) -> bool:
        """Whether the column holds numbers, as far as it holds anything."""
        cells = [row[column] for row in self.rows if row[column]]
        return bool(cells) and all(cell[0].isdigit() or cell[0] in "-+<" for cell in cells)


def error_table(train: Comparison, validation: Comparison | None) -> Table:
    """Error of every channel before and after, for both sides of the split."""
    rows = []
    two = len(train.models) > 1
    for which, comparison in (("train", train), ("validation", validation)):
        if comparison is None:
            continue
        before, after = comparison.models[0].errors, comparison.models[-1].errors
        for channel, error in before.items():
            row = [which, channel, f"{error.fit_percent:.2f}", f"{error.rms:.3g}", f"{error.rms_over_noise:.2f}"]
            if two:
                then = after[channel]
                row += [f"{then.fit_percent:.2f}", f"{then.rms:.3g}", f"{then.rms_over_noise:.2f}"]
            rows.append(tuple(row))
    header = ["data", "channel", "fit [%]", "rms [SI]", "rms/noise"]
    header += ["fit after [%]", "rms after [SI]", "rms/noise after"] if two else []
    return Table(tuple(header), tuple(rows), "Error of free simulation; the noise is that of the sensor.")


def parameter_table(fit: Fit, *, base: Fit | None = None) -> Table:
    """Parameters with standard deviations; with a base fit its values before them."""
    rows = []
    known = base.parameters if base is not None else {}
    for name, p in fit.parameters.items():
        std = f"{p.std:.2g}" if name in fit.information.names else "fixed"
        row = [name, f"{p.value:.6g}", std, p.unit]
        if base is not None:
            row.insert(1, f"{known[name].value:.6g}" if name in known else "")
        rows.append(tuple(row))
    header = (
        ("parameter", "before", "value", "std", "unit") if base is not None else ("parameter", "value", "std", "unit")
    )
    return Table(header, tuple(rows))


def side_by_side(closed: ClosedForm, fit: Fit) -> Table:
    """Closed form and output error."""
    rows = []
    for name, p in fit.parameters.items():
        e = closed.estimates.get(name)
        value = "" if e is None else f"{e.value:.5g}"
        spread = "" if e is None or not math.isfinite(e.std) else f"{e.std:.2g}"
        std = f"{p.std:.2g}" if name in fit.information.names else "fixed"
        rows.append((name, value, spread, f"{p.value:.6g}", std, p.unit))
    return Table(("parameter", "closed form", "std", "output error", "std", "unit"), tuple(rows))


def comparison_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Error of every channel of every experiment, as `comparison_rows` gives it."""
    header = ("experiment", "channel", "fit [%]", "rms [SI]", "rms/noise", "residual")
    return Table(
        header,
        tuple(
            (
                row["experiment"],
                row["channel"],
                "" if row["fit_percent"] is None else f"{row['fit_percent']:.2f}",
                f"{row['rms']:.3g}",
                f"{row['rms_over_noise']:.2f}",
                "white" if row["whiteness_p"] > 0.01 else "not white",
            )
            for row in rows
        ),
    )


def evidence_table(diagnosis: Diagnosis) -> Table:
    """The tests of whether anything is missing, before and after what was added."""
    after = {test.test: test for test in diagnosis.left} if diagnosis.additions else {}
    rows = []
    for test in diagnosis.tests:
        row = [test.test, f"{test.p_value:.2g}", "rejects" if test.rejects else "passes", test.words]
        if diagnosis.additions:
            then = after.get(test.test)
            row[3:3] = [""] if then is None else [f"{'rejects' if then.rejects else 'passes'} (p {then.p_value:.2g})"]
        rows.append(tuple(row))
    header = ["test", "p", "base model", "in words"]
    if diagnosis.additions:
        header.insert(3, "with what was added")
    return Table(
        tuple(header), tuple(rows), "Is anything missing? All tests together reject one right model in a hundred."
    )


def place_table(diagnosis: Diagnosis, most: int = 8) -> Table:
    """Where the innovations of the base model are too large."""
    rows = [
        (p.by, p.label, p.channel, f"{p.value:.2f}", f"{p.high:.2f}") for p in diagnosis.places[:most] if p.excess > 1
    ]
    header = ("by", "part", "channel", "mean square", "99 % bound")
    return Table(header, tuple(rows), "Squared innovations where they exceed what chance allows, worst first.")


def candidate_table(diagnosis: Diagnosis) -> Table:
    """All candidates, best first."""
    accepted = {c.id for c in diagnosis.effects}
    rows = []
    for c in diagnosis.candidates:
        limit = f"{c.detection_limit:.2g} {c.unit}" if c.testable and math.isfinite(c.detection_limit) else ""
        rows.append(
            (
                c.id,
                f"{c.score:.1f}",
                f"{c.p_value:.2g}",
                f"{c.bic_gain:.1f}" if c.refitted else "",
                f"{100 * c.error_reduction:.0f}" if c.refitted else "",
                limit or "not testable with these data",
                "accepted" if c.id in accepted else "",
            )
        )
    header = ("effect", "score", "p", "BIC gain", "explains [%]", "would be found from", "")
    return Table(header, tuple(rows))


# -- files -----------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Shown:
    """A figure and what it shows."""

    figure: Figure
    caption: str


Block = str | Table | Shown
Section = tuple[str, Sequence[Block]]


def write_bytes(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a file so that whoever reads it finds the old or the new one, never a part."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: str | os.PathLike[str], content: Mapping[str, Any]) -> None:
    """Write a dictionary as JSON; what JSON does not know, such as NaN, becomes null."""
    write_bytes(path, (json.dumps(_clean(content), indent=1, allow_nan=False) + "\n").encode())


def write_figures(folder: str | os.PathLike[str], figures: Mapping[str, Figure]) -> dict[Figure, bytes]:
    """Write every figure as NAME.png and NAME.svg; returns what is in the PNG files, for `write_report`."""
    from estimators.plots._style import image_bytes

    images = {}
    for name, figure in figures.items():
        images[figure] = image_bytes(figure, "png")
        write_bytes(Path(folder) / f"{name}.png", images[figure])
        write_bytes(Path(folder) / f"{name}.svg", image_bytes(figure, "svg"))
    return images


def versions() -> Table:
    """What the numbers were computed with."""
    rows = [("python", platform.python_version())]
    for name in _PACKAGES:
        try:
            rows.append((name, importlib.metadata.version(name)))
        except importlib.metadata.PackageNotFoundError:
            rows.append((name, "not installed"))
    return Table(("package", "version"), tuple(rows))


def write_report(
    path: str | os.PathLike[str],
    title: str,
    sections: Sequence[Section],
    *,
    images: Mapping[Figure, bytes] | None = None,
) -> None:
    """Write one HTML file with style and figures inside.

    Args:
        title: heading of the page.
        sections: headings, each with paragraphs, tables and figures in their order; the first is the summary.
        images: figures that were rendered before, as PNG; drawing them again takes a second each.
    """
    body = [f"<h1>{html.escape(title)}</h1>"]
    for number, (heading, blocks) in enumerate(sections):
        body.append(f'<section class="{"summary" if number == 0 else "part"}"><h2>{html.escape(heading)}</h2>')
        body += [_block(block, images or {}) for block in blocks]
        body.append("</section>")
    page = (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head>\n"
        f"<body>\n{chr(10).join(body)}\n</body></html>\n"
    )
    write_bytes(path, page.encode())


def _block(block: Block, images: Mapping[Figure, bytes]) -> str:
    if isinstance(block, str):
        return f"<p>{html.escape(block)}</p>"
    if isinstance(block, Shown):
        from estimators.plots._style import image_bytes

        image = images[block.figure] if block.figure in images else image_bytes(block.figure, "png")
        data = base64.b64encode(image).decode()
        caption = html.escape(block.caption)
        shown = f'<img alt="{caption}" src="data:image/png;base64,{data}">'
        return f"<figure>{shown}<figcaption>{caption}</figcaption></figure>"
    kinds = [' class="n"' if block.numeric(i) else "" for i in range(len(block.header))]

    def row(cells: Sequence[str], tag: str) -> str:
        inside = (f"<{tag}{kind}>{html.escape(cell)}</{tag}>" for cell, kind in zip(cells, kinds, strict=True))
        return f"<tr>{''.join(inside)}</tr>"

    caption = f"<caption>{html.escape(block.caption)}</caption>" if block.caption else ""
    rows = "\n".join(row(cells, "td") for cells in block.rows)
    head = f"<thead>{row(block.header, 'th')}</thead>"
    return f'<div class="wide"><table>{caption}{head}\n<tbody>{rows}</tbody></table></div>'


_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff; max-width: 62rem; margin: 2rem auto;
  padding: 0 1rem; }
h1 { font-size: 1.6rem; margin-bottom: 0.4rem; }
h2 { font-size: 1.15rem; margin: 2rem 0 0.5rem; border-bottom: 1px solid #ccc; padding-bottom: 0.2rem; }
.summary { background: #f3f6fa; border-left: 5px solid #08306b; padding: 0.4rem 1.2rem 0.6rem; }
.summary h2 { border: 0; margin-top: 0.6rem; }
table { border-collapse: collapse; margin: 0.6rem 0; font-size: 0.9rem; }
caption { caption-side: bottom; text-align: left; color: #555; padding-top: 0.3rem; }
th, td { text-align: left; padding: 0.2rem 0.8rem 0.2rem 0; border-bottom: 1px solid #e3e3e3; }
th { border-bottom: 2px solid #888; }
.n { text-align: right; font-variant-numeric: tabular-nums; }
.wide { overflow-x: auto; }
figure { margin: 1rem 0 1.6rem; }
img { max-width: 100%; height: auto; }
figcaption { color: #555; font-size: 0.9rem; }
"""
