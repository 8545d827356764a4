"""Overviews of records: one line for a terminal, a small table for a notebook."""

import dataclasses
import html
from collections.abc import Collection, Sequence

MOST_ROWS = 12
"""Rows of an overview; what it is of prints the others."""

_CELL = "text-align:left;padding:0.1em 0.8em 0.1em 0"


@dataclasses.dataclass(frozen=True)
class Overview:
    """The gist of a record.

    Attributes:
        title: one line.
        header: names of the columns; empty where there is no table.
        rows: cells of the table, as text.
        notes: sentences below it.
    """

    title: str
    header: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()
    notes: Sequence[str] = ()

    def to_html(self) -> str:
        """Return the overview as HTML, escaped, without any style but that of its own cells."""
        parts = [f"<p><b>{html.escape(self.title)}</b></p>"]
        if self.header:
            lines = [_line(self.header, "th"), *(_line(row, "td") for row in self.rows[:MOST_ROWS])]
            parts.append(f"<table>{''.join(lines)}</table>")
        if len(self.rows) > MOST_ROWS:
            parts.append(f"<p>{len(self.rows) - MOST_ROWS} more: print it.</p>")
        return f"<div>{''.join(parts)}{''.join(f'<p>{html.escape(note)}</p>' for note in self.notes if note)}</div>"


def _line(cells: Sequence[str], tag: str) -> str:
    return f"<tr>{''.join(f'<{tag} style={_CELL!r}>{html.escape(str(cell))}</{tag}>' for cell in cells)}</tr>"


def aligned(rows: Sequence[Sequence[str]], right: Collection[int] = ()) -> list[str]:
    """Return the rows of a table as lines of equal columns, those in `right` set to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.rjust(width) if i in right else cell.ljust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def shortened(text: str, most: int = 240) -> str:
    """Return a text cut at the end of a sentence or word, where it is longer than so many characters."""
    if len(text) <= most:
        return text
    cut = text[:most]
    return cut[: cut.rfind(". ") + 1] if ". " in cut else f"{cut[: cut.rfind(' ')]} ..."
