"""Parts of evaluation.html, report.html and tradeoff.html: single files with their images inside.

Functions that end in _html take plain text (from files, names, folders) and escape it.
"""

import base64
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

import cv2
import numpy as np

from ..base.html_page import number
from ..base.isolation import import_matplotlib

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FULL_ERROR = 51
"""Difference in 8-bit values (a fifth of the scale) from which on the error map is brightest."""
BLUE = "#2a7f9e"
"""Color of curves and bars, visible on light and dark pages."""
INK = "#010203"
"""Color of text and axes in a plot, replaced by the text color of the page, light or dark."""


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
        confidence: Confidence (H, W) in its colors, float 0..1, NaN where nothing is restored; None if not shown.
    """

    name: str
    photo: np.ndarray
    render: np.ndarray
    valid: np.ndarray
    restored: np.ndarray | None = None
    confidence: np.ndarray | None = None


def views_html(views: Sequence[ViewComparison], captions: Sequence[str] | None = None) -> list[str]:
    """Show each view: photo, rendered image, error map, and image without water and its confidence where there are any.

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
    if any(view.confidence is not None for view in views):
        lines.append(
            "<p>Confidence maps show how far the color without water is known, in its least certain channel: 0 "
            f"{_image(_scale(), 'scale')} 1. Below 0.5 noise and errors of the water outweigh what is left of the "
            "light, and the color that is most likely in this scene takes its place. Grey pixels show open water.</p>"
        )
    for view, caption in zip(views, captions or [""] * len(views), strict=True):
        shown = {"photo": view.photo, "rendered": view.render, "error": _error_map(view)}
        if view.restored is not None:
            shown["rendered without water"] = view.restored
        if view.confidence is not None:
            known = np.isfinite(view.confidence)[..., None]
            shown["confidence"] = np.where(known, _colors(np.nan_to_num(view.confidence)), np.uint8(128))
        figures = (f"<figure>{_image(p)}<figcaption>{name}</figcaption></figure>" for name, p in shown.items())
        lines += [f"<h3>{escape(view.name)}{': ' if caption else ''}{escape(caption)}</h3>"]
        lines += [f'<div class="pictures">{"".join(figures)}</div>']
    return lines


def _error_map(view: ViewComparison) -> np.ndarray:
    """Return the mean absolute difference over the channels as colors (H, W, 3) uint8, black for none."""
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
    import_matplotlib()
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
    """Draw a figure as vector graphics in the text color of the page.

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
