"""HTML pages that are single files: style, page, paragraphs, tables.

Functions that end in _html take plain text (from files, names, folders) and escape it.
"""

from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

import numpy as np

from .files import atomic_path

NONE = "–"
"""Text of a number that is not known."""

STYLE = """
:root { color-scheme: light dark; --line: #8886; --bar: #2a7f9e; }
body { font: 16px/1.5 system-ui, sans-serif; margin: 0 auto; padding: 1.5rem; max-width: 80rem; }
h1, h2, h3 { line-height: 1.2; }
h2 { margin-top: 2.5rem; }
h3 { margin: 1.5rem 0 .5rem; font-size: 1rem; }
p, li { max-width: 48rem; overflow-wrap: anywhere; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .9rem .3rem 0; text-align: left; vertical-align: top; border-bottom: 1px solid var(--line); }
td { overflow-wrap: break-word; }
td.text { min-width: 14rem; }
.number { text-align: right; white-space: nowrap; }
.meaning { min-width: 14rem; }
.meaning, figcaption { font-size: .875rem; opacity: .8; }
.note { border-left: .25rem solid var(--bar); padding-left: .8rem; }
.pictures, .plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(45%, 16rem), 1fr)); gap: .8rem; }
.plots { grid-template-columns: repeat(auto-fit, minmax(min(100%, 21rem), 1fr)); }
figure { margin: 0; break-inside: avoid; }
figure img, figure svg { display: block; width: 100%; height: auto; }
.scale { width: 8rem; height: .7rem; margin: 0 .4rem; }
.bar { display: block; height: .8rem; margin-top: .35rem; background: var(--bar); print-color-adjust: exact;
  -webkit-print-color-adjust: exact; }
.bars { width: 40%; min-width: 6rem; }
pre { overflow-x: auto; padding: .8rem; border: 1px solid var(--line); white-space: pre-wrap; overflow-wrap: anywhere; }
@media print { body { font-size: 10pt; max-width: none; padding: 0; } h2, h3 { break-after: avoid; } }
"""


def write_page(path: Path, title: str, parts: Iterable[str]) -> None:
    """Write one HTML file.

    Args:
        path: The file.
        title: Title, as plain text.
        parts: Parts of the body, as HTML.

    Raises:
        InputError: When the file cannot be written.
    """
    head = (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{STYLE}</style></head><body>'
        f"<h1>{escape(title)}</h1>"
    )
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join([head, *parts, "</body></html>\n"]), encoding="utf-8")


def number(value: float | None, digits: int, unit: str = "") -> str:
    """Format a number with so many digits and a unit; NONE where it is not known or not finite."""
    return NONE if value is None or not np.isfinite(value) else f"{value:,.{digits}f}{unit}"


def paragraph_html(text: str, style: str = "") -> str:
    """Make a paragraph; the style is "note" or empty."""
    return f'<p class="{style}">{escape(text)}</p>' if style else f"<p>{escape(text)}</p>"


def table_html(rows: Iterable[Sequence[str]], heads: Sequence[str] = (), styles: Sequence[str] = ()) -> str:
    """Make a table.

    Args:
        rows: Texts of the cells.
        heads: Texts of the first row, none without.
        styles: Style of each column: "number", "meaning", "text" or empty.

    Returns:
        HTML.
    """

    def row(tag: str, cells: Sequence[str]) -> str:
        classes = [*styles, *[""] * len(cells)]
        shown = (
            f'<{tag} class="{style}">{escape(cell)}</{tag}>' if style else f"<{tag}>{escape(cell)}</{tag}>"
            for cell, style in zip(cells, classes, strict=False)
        )
        return f"<tr>{''.join(shown)}</tr>"

    lines = [row("th", heads)] if heads else []
    return "\n".join(['<div class="wide"><table>', *lines, *(row("td", cells) for cells in rows), "</table></div>"])
