"""Sheets of coded targets to print at true size, as a vector PDF."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import InputError
from ..base.files import atomic_path
from ..base.isolation import import_matplotlib
from .papers import PAPERS
from .targets import target_cells

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INCH = 25.4
MARGIN = 5.0
"""Millimetres at the border of the paper that are not printed on."""
CAPTION = 9.0
"""Millimetres below each target for its name."""
FOOT = 16.0
"""Millimetres at the bottom of the page for the bar that shows the scale of the print."""
MOST_TARGETS = 1000


@dataclass(frozen=True)
class Sheet:
    """What is printed.

    Attributes:
        family: A name of FAMILIES (georeference/families.py).
        size: Edge length of a target with its black border, metres.
        count: Number of targets.
        first: Number of the first one.
        paper: A name of PAPERS.

    Raises:
        InputError: If a target does not fit on the paper, or the family has too few.
    """

    family: str
    size: float
    count: int
    first: int
    paper: str

    def __post_init__(self) -> None:
        if not 1 <= self.count <= MOST_TARGETS:
            raise InputError(f"The number of targets is {self.count}: it must be from 1 to {MOST_TARGETS}.")
        for number in (self.first, self.first + self.count - 1):
            target_cells(self.family, number)
        if not self.size >= 0.005:
            raise InputError(f"The size of the targets is {self.size:g} m: an edge must be at least 0.005 m long.")
        if not all(self.grid):
            width, height = PAPERS[self.paper]
            fits = min(width - 2 * MARGIN, height - 2 * MARGIN - CAPTION - FOOT) * self._cells / (self._cells + 2)
            raise InputError(
                f"A target of {self.size:g} m with its white margin does not fit on {self.paper}: at most "
                f"{math.floor(fits) / 1000:g} m does; choose a larger paper or a smaller size."
            )

    @property
    def _cells(self) -> int:
        """Cells along an edge with the black border."""
        return len(target_cells(self.family, self.first))

    @property
    def edge(self) -> float:
        """Edge of a target in millimetres."""
        return 1000 * self.size

    @property
    def tile(self) -> float:
        """Edge in millimetres of a target with a white margin of one cell."""
        return self.edge * (1 + 2 / self._cells)

    @property
    def grid(self) -> tuple[int, int]:
        """Columns and rows of a page."""
        width, height = PAPERS[self.paper]
        columns = int((width - 2 * MARGIN + 1e-6) / self.tile)
        return columns, int((height - 2 * MARGIN - FOOT + 1e-6) / (self.tile + CAPTION))


def write_sheet(path: Path, sheet: Sheet) -> dict[str, Any]:
    """Write targets to a PDF, which is whole or absent.

    Args:
        path: The file.
        sheet: What is printed.

    Returns:
        `out`, `pages`, and the numbers of the `targets`.

    Raises:
        InputError: If the file cannot be written.
    """
    import_matplotlib()
    from matplotlib.backends.backend_pdf import PdfPages

    if path.suffix.lower() != ".pdf":
        raise InputError(f"{path.name} is no PDF: choose a name that ends in .pdf.")
    pages = 0
    with atomic_path(path) as temporary, PdfPages(temporary) as pdf:
        for figure in draw_pages(sheet):
            pdf.savefig(figure)
            pages += 1
    targets = list(range(sheet.first, sheet.first + sheet.count))
    return {"out": str(path), "pages": pages, "family": sheet.family, "size": sheet.size, "targets": targets}


def describe(document: dict[str, Any]) -> str:
    """Return the lines that the command `targets` prints.

    Args:
        document: What `write_sheet` returned.
    """
    pages = "1 page" if document["pages"] == 1 else f"{document['pages']} pages"
    return (
        f"{document['out']}: {len(document['targets'])} targets on {pages}.\n"
        "Print it at 100 % (not fitted to the page), measure the bar, and fix the targets flat on something rigid.\n"
        f"Then: scale SCENE --targets {document['family']} --size {document['size']:g}"
    )


def draw_pages(sheet: Sheet) -> Iterator["Figure"]:
    """Draw the pages.

    Args:
        sheet: What is printed.

    Yields:
        A figure of the size of the paper, whose data coordinates are millimetres from its lower left corner.
    """
    import_matplotlib()
    from matplotlib.figure import Figure

    width, height = PAPERS[sheet.paper]
    columns, rows = sheet.grid
    numbers = range(sheet.first, sheet.first + sheet.count)
    left = (width - columns * sheet.tile) / 2
    for start in range(0, sheet.count, columns * rows):
        figure = Figure(figsize=(width / INCH, height / INCH))
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set_axis_off()
        axes.set(xlim=(0, width), ylim=(0, height))
        for index, number in enumerate(numbers[start : start + columns * rows]):
            row, column = divmod(index, columns)
            _draw_target(
                axes, sheet, number, left + column * sheet.tile, height - MARGIN - row * (sheet.tile + CAPTION)
            )
        _draw_bar(axes, width)
        yield figure


def _draw_target(axes: Any, sheet: Sheet, number: int, left: float, top: float) -> None:
    """Draw a target with its margin and name, and cutting marks around both; `left` and `top` are the margin's."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    cells = target_cells(sheet.family, number)
    cell = sheet.edge / len(cells)
    corners, codes = [], []
    for row, column in np.argwhere(cells):
        x, y = left + (column + 1) * cell, top - (row + 1) * cell
        corners += [(x, y), (x + cell, y), (x + cell, y - cell), (x, y - cell), (x, y)]
        codes += [Outline.MOVETO, Outline.LINETO, Outline.LINETO, Outline.LINETO, Outline.CLOSEPOLY]
    # One path: programs leave white hairlines between shapes that touch.
    axes.add_patch(PathPatch(Outline(corners, codes), facecolor="black", linewidth=0))
    right, bottom, mark = left + sheet.tile, top - sheet.tile, 0.3 * cell
    for x, to_x in ((left, mark), (right, -mark)):
        for y, to_y in ((top, -mark), (bottom - CAPTION, mark)):
            axes.plot([x + to_x, x, x], [y, y, y + to_y], color="0.5", linewidth=0.3)
    text = f"{sheet.family}   {number}   {sheet.edge:g} mm"
    size = min(9.0, 1.7 * sheet.tile / len(text) * 72 / INCH)
    axes.text((left + right) / 2, bottom - 0.25 * CAPTION, text, ha="center", va="top", fontsize=size)


def _draw_bar(axes: Any, width: float) -> None:
    """Draw a bar of 100 mm to check the scale of the print."""
    left, y = (width - 100) / 2, MARGIN + 4
    axes.plot([left, left + 100], [y, y], color="black", linewidth=0.5)
    for step in range(11):
        high = 2.5 if step % 5 == 0 else 1.5
        axes.plot([left + 10 * step] * 2, [y, y + high], color="black", linewidth=0.5)
    text = "100 mm: measure this bar; where it is longer or shorter, print again at 100 %"
    axes.text(width / 2, y - 1, text, ha="center", va="top", fontsize=7)
