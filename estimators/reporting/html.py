"""Tables and figures as one HTML file that needs nothing else, and results as JSON."""

import base64
import dataclasses
import html
import importlib.metadata
import json
import math
import os
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rtac_jax.measurement.atomic_write import replacing
from rtac_jax.overview import aligned

_NARROW = 3  # columns that fit into the width of a telephone
_MANY = 8  # columns beyond which a table takes the width of the window, not that of the text
_WORDS = ("fixed",)  # that may stand in a column of numbers
_PACKAGES = ("rtac-jax", "jax", "optimistix", "numpy", "scipy", "matplotlib")


@dataclasses.dataclass(frozen=True)
class Table:
    """The rows of a table as text, under a header; columns of numbers are set to the right.

    Attributes:
        header, rows: the cells.
        caption: stands with it on a page.
        note: stands below it, on the screen too.
    """

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""
    note: str = ""

    def __str__(self) -> str:
        numbers = [i for i in range(len(self.header)) if self.numeric(i)]
        return "\n".join([*aligned((self.header, *self.rows), right=numbers), *([self.note] if self.note else [])])

    def numeric(self, column: int) -> bool:
        """Return whether the column holds numbers, as far as it holds anything."""
        cells = [row[column] for row in self.rows if row[column] not in ("", *_WORDS)]
        return bool(cells) and all(cell[0].isdigit() or cell[0] in "-+<" for cell in cells)


@dataclasses.dataclass(frozen=True)
class Shown:
    """A figure and its caption."""

    figure: Figure
    caption: str


@dataclasses.dataclass(frozen=True)
class Bullets:
    """The beginning of a report: what was found, how sure that is, and what to do next."""

    found: str
    sure: str
    next: str


@dataclasses.dataclass(frozen=True)
class Embedded:
    """A part of a page that is HTML already, and the script that it needs, which a page holds once."""

    markup: str
    script: str = ""


Block = str | Table | Shown | Bullets | Embedded
Section = tuple[str, Sequence[Block]]


def write_bytes(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a file so that whoever reads it finds the old or the new one, never a part."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def write_json(path: str | os.PathLike[str], content: Mapping[str, Any]) -> None:
    """Write a dictionary as JSON; what JSON does not know, such as NaN, becomes null."""
    write_bytes(path, (json.dumps(cleaned(content), indent=1, allow_nan=False) + "\n").encode())


def cleaned(value: object) -> Any:
    """Reduce a value to what JSON knows: it has neither NaN nor infinity, and no arrays."""
    if isinstance(value, Mapping):
        return {str(key): cleaned(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [cleaned(part) for part in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value


def write_figures(folder: str | os.PathLike[str], figures: Mapping[str, Figure]) -> dict[Figure, bytes]:
    """Write every figure as NAME.png and NAME.svg; returns what is in the PNG files, for `write_report`."""
    from estimators.plots.style import image_bytes

    images = {}
    for name, figure in figures.items():
        images[figure] = image_bytes(figure, "png")
        write_bytes(Path(folder) / f"{name}.png", images[figure])
        write_bytes(Path(folder) / f"{name}.svg", image_bytes(figure, "svg"))
    return images


def versions() -> Table:
    """Return a table of the versions of Python and packages that computed the numbers."""
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
        path: of the file.
        title: heading of the page.
        sections: headings, each with paragraphs, tables and figures in their order; the first is the summary.
        images: figures that were rendered before, as PNG; drawing them again takes a second each.
    """
    body = [f"<h1>{html.escape(title)}</h1>"]
    for number, (heading, blocks) in enumerate(sections):
        body.append(f'<section class="{"summary" if number == 0 else "part"}"><h2>{html.escape(heading)}</h2>')
        body += [_block(block, images or {}) for block in blocks]
        body.append("</section>")
    scripts = dict.fromkeys(b.script for _, blocks in sections for b in blocks if isinstance(b, Embedded) and b.script)
    body += [f"<script>\n{script}</script>" for script in scripts]
    page = (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head>\n"
        f"<body>\n{chr(10).join(body)}\n</body></html>\n"
    )
    write_bytes(path, page.encode())


def _marked(text: str) -> str:
    """Escape text for HTML, with the signs that a terminal may not have."""
    for plain, sign in ((" +- ", " ± "), ("^2", "²"), ("^3", "³")):
        text = text.replace(plain, sign)
    return html.escape(text)


def _block(block: Block, images: Mapping[Figure, bytes]) -> str:
    if isinstance(block, str):
        return f"<p>{_marked(block)}</p>"
    if isinstance(block, Embedded):
        return block.markup
    if isinstance(block, Bullets):
        heads = (("Found", block.found), ("How sure", block.sure), ("Next", block.next))
        return f"<ul>{''.join(f'<li><b>{head}.</b> {_marked(text)}</li>' for head, text in heads)}</ul>"
    if isinstance(block, Shown):
        from estimators.plots.style import image_bytes

        image = images[block.figure] if block.figure in images else image_bytes(block.figure, "png")
        data = base64.b64encode(image).decode()
        caption = _marked(block.caption)
        shown = f'<img alt="{caption}" src="data:image/png;base64,{data}">'
        return f"<figure>{shown}<figcaption>{caption}</figcaption></figure>"
    kinds = [' class="n"' if block.numeric(i) else "" for i in range(len(block.header))]

    def row(cells: Sequence[str], tag: str) -> str:
        # A narrow page sets the cells of a row below each other, each behind the head of its column.
        heads = (f' data-head="{_marked(head)}"' if tag == "td" else "" for head in block.header)
        inside = (
            f"<{tag}{kind}{head}>{_marked(cell)}</{tag}>" for cell, kind, head in zip(cells, kinds, heads, strict=True)
        )
        return f"<tr>{''.join(inside)}</tr>"

    said = " ".join(filter(None, (block.note, block.caption)))
    caption = f"<caption>{_marked(said)}</caption>" if said else ""
    rows = "\n".join(row(cells, "td") for cells in block.rows)
    head = f"<thead>{row(block.header, 'th')}</thead>"
    stacks = ' class="stacks"' if len(block.header) > _NARROW else ""
    room = "wide many" if len(block.header) > _MANY else "wide"
    return f'<div class="{room}"><table{stacks}>{caption}{head}\n<tbody>{rows}</tbody></table></div>'


_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff; max-width: 62rem; margin: 2rem auto;
  padding: 0 1rem; }
h1 { font-size: 1.6rem; margin-bottom: 0.4rem; }
h2 { font-size: 1.15rem; margin: 2rem 0 0.5rem; border-bottom: 1px solid #ccc; padding-bottom: 0.2rem; }
p { white-space: pre-line; }
.summary { background: #f3f6fa; border-left: 5px solid #08306b; padding: 0.4rem 1.2rem 0.6rem; }
.summary h2 { border: 0; margin-top: 0.6rem; }
table { border-collapse: collapse; margin: 0.6rem 0; font-size: 0.9rem; }
caption { caption-side: bottom; text-align: left; color: #555; padding-top: 0.3rem; }
th, td { text-align: left; padding: 0.2rem 0.8rem 0.2rem 0; border-bottom: 1px solid #e3e3e3; }
th { border-bottom: 2px solid #888; }
.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
th.n { white-space: normal; }
td:last-child, th:last-child { padding-right: 0; }
.wide { overflow-x: auto; }
.many { position: relative; left: 50%; transform: translateX(-50%); width: max-content; min-width: 100%; max-width: 96vw; }
figure { margin: 1rem 0 1.6rem; }
img { max-width: 100%; height: auto; }
figcaption, .caption { color: #555; font-size: 0.9rem; }
.summary li { margin: 0.3rem 0; overflow-wrap: anywhere; }
.viewer svg { box-sizing: border-box; width: 100%; height: auto; touch-action: pan-y; cursor: grab; border: 1px solid #e3e3e3; }
.viewer .bar { display: flex; flex-wrap: wrap; gap: 0.3rem; margin-bottom: 0.3rem; }
.viewer select, .viewer button { font: inherit; font-size: 0.85rem; max-width: 100%; }
.viewer .grid { stroke: #e3e3e3; }
.viewer .tick { font: 11px system-ui, sans-serif; fill: #444; }
.viewer .legend span { border-left: 1.2rem solid; padding-left: 0.4rem; margin-right: 1rem; font-size: 0.85rem; }
@media (max-width: 600px) {
  body { margin: 0.5rem auto; padding: 0 0.6rem; }
  .summary { padding: 0.2rem 0.6rem; }
  .summary ul { padding-left: 1.1rem; }
  p, li, td { overflow-wrap: anywhere; }
  figure { overflow-x: auto; }
  figure img { max-width: none; width: 40rem; }
  figcaption::after { content: " The picture is wider than this page: move it sideways."; }
  .many { position: static; transform: none; width: auto; min-width: 0; max-width: none; }
  table.stacks, .stacks tbody, .stacks tr, .stacks td { display: block; }
  .stacks thead { display: none; }
  .stacks caption { display: block; }
  .stacks tr { border-bottom: 2px solid #888; padding: 0.3rem 0; }
  .stacks td { display: flex; justify-content: space-between; gap: 1rem; border-bottom: 1px solid #eee; white-space: normal;
    padding-right: 0; text-align: right; }
  .stacks td:empty { display: none; }
  .stacks td::before { content: attr(data-head); color: #555; text-align: left; flex: none; max-width: 45%; }
}
"""
