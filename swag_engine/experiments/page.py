"""Parts of evaluation.html, report.html and tradeoff.html: single files with their images inside.

Functions that end in _html take plain text (from files, names, folders) and escape it.
"""

import base64
import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from ..base.files import atomic_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FULL_ERROR = 51
"""Difference in 8-bit values (a fifth of the scale) from which on the error map is brightest."""
NONE = "–"
"""Text of a number that is not known."""
BLUE = "#2a7f9e"
"""Colour of curves and bars, visible on light and dark pages."""
INK = "#010203"
"""Colour of text and axes in a plot, replaced by the text colour of the page, light or dark."""

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


def bars_html(values: dict[str, float], title: str, unit: str) -> str:
    """Make a table of values, largest first, with a bar and the percentage of the sum for each.

    Args:
        values: Values by name.
        title: Head of the column of names.
        unit: Head of the column of values.

    Returns:
        HTML.
    """
    total = sum(values.values()) or 1.0
    most = max(values.values(), default=0) or 1.0
    rows = [
        f'<tr><td>{escape(name)}</td><td class="number">{number(value, 2)}</td>'
        f'<td class="number">{value / total:.0%}</td><td class="bars">'
        f'<span class="bar" style="width: {100 * max(value, 0) / most:.1f}%"></span></td></tr>'
        for name, value in sorted(values.items(), key=lambda item: -item[1])
    ]
    heads = (f'<th class="number">{escape(head)}</th>' for head in (unit, "percentage"))
    head = f"<tr><th>{escape(title)}</th>{''.join(heads)}<th></th></tr>"
    whole = f'<tr><th>sum</th><th class="number">{number(sum(values.values()), 2)}</th><th></th><th></th></tr>'
    return "\n".join(['<div class="wide"><table style="width: 100%">', head, *rows, whole, "</table></div>"])


# Images ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ViewComparison:
    """Images of one test view, all (H, W, 3) uint8 sRGB.

    Attributes:
        name: Name of the view.
        photo: Image of the scene.
        render: Rendered image.
        valid: Valid pixels (H, W) bool.
        restored: Rendered image without water, None without a water model.
    """

    name: str
    photo: np.ndarray
    render: np.ndarray
    valid: np.ndarray
    restored: np.ndarray | None = None


def views_html(views: Sequence[ViewComparison], captions: Sequence[str] | None = None) -> list[str]:
    """Show each view: photo, rendered image and error map, and the rendered image without water where there is one.

    Args:
        views: The views.
        captions: A line of text for each view.

    Returns:
        Parts of HTML.
    """
    lines = [
        f"<p>Error maps show the mean difference of red, green and blue: 0 {_image(_scale(), 'scale')} "
        f"{FULL_ERROR / 255:.0%} of the full scale or more. Grey pixels are not compared.</p>"
    ]
    for view, caption in zip(views, captions or [""] * len(views), strict=True):
        shown = {"photo": view.photo, "rendered": view.render, "error": _error_map(view)}
        if view.restored is not None:
            shown["rendered without water"] = view.restored
        figures = (f"<figure>{_image(p)}<figcaption>{name}</figcaption></figure>" for name, p in shown.items())
        lines += [f"<h3>{escape(view.name)}{': ' if caption else ''}{escape(caption)}</h3>"]
        lines += [f'<div class="pictures">{"".join(figures)}</div>']
    return lines


def _error_map(view: ViewComparison) -> np.ndarray:
    """Return the mean absolute difference over the channels as colours (H, W, 3) uint8, black for none."""
    error = np.abs(view.render.astype(np.float32) - view.photo).mean(-1)
    return np.where(view.valid[..., None], _colors(error / FULL_ERROR), np.uint8(128))


def _scale() -> np.ndarray:
    return _colors(np.tile(np.linspace(0, 1, 128, dtype=np.float32), (8, 1)))


def _colors(values: np.ndarray) -> np.ndarray:
    mapped = cv2.applyColorMap((values.clip(0, 1) * 255).astype(np.uint8), cv2.COLORMAP_INFERNO)
    return cv2.cvtColor(mapped, cv2.COLOR_BGR2RGB)


def _image(pixels: np.ndarray, style: str = "") -> str:
    """Return an img element with the image inside it."""
    encoded = cv2.imencode(".jpg", np.ascontiguousarray(pixels[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 92])[1]
    return f'<img class="{style}" alt="" src="data:image/jpeg;base64,{base64.b64encode(encoded.tobytes()).decode()}">'


# Plots ----------------------------------------------------------------------------------------------------------------


def new_plots(x: str, *ys: str) -> "tuple[Figure, list[Axes]]":
    """Make empty plots, two in a row, with text and axes in INK.

    Args:
        x: Label of the x axis.
        *ys: Label of the y axis of each plot.

    Returns:
        The figure and its plots.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context({"text.color": INK, "axes.edgecolor": INK, "axes.labelcolor": INK, "xtick.color": INK,
                     "ytick.color": INK}):  # fmt: skip
        rows, columns = (len(ys) + 1) // 2, min(2, len(ys))
        figure = Figure((4.6 * columns, 3.0 * rows), layout="constrained")
        plots = [figure.add_subplot(rows, columns, place + 1) for place in range(len(ys))]
        for axes, y in zip(plots, ys, strict=True):
            axes.set(xlabel=x, ylabel=y)
            axes.spines[["top", "right"]].set_visible(False)
            axes.grid(alpha=0.25, linewidth=0.6, color="#888888")
    return figure, plots


def plot_html(figure: "Figure", caption: str) -> str:
    """Draw a figure as vector graphics in the text colour of the page.

    Args:
        figure: The figure.
        caption: Its caption.

    Returns:
        HTML.
    """
    from matplotlib import rc_context

    written = io.StringIO()
    nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": caption, "font.family": "sans-serif"}):
        figure.savefig(written, format="svg", transparent=True, metadata=nothing)
    drawing = written.getvalue()
    drawing = drawing[drawing.index("<svg") :].replace(INK, "currentColor")
    # HTML needs no namespaces, and without them the page contains no address.
    drawing = re.sub(r' xmlns(:\w+)?="[^"]*"', "", drawing).replace("xlink:href", "href")
    caption = escape(caption)
    return f'<figure role="img" aria-label="{caption}">{drawing}<figcaption>{caption}</figcaption></figure>'
