"""The pixels of a map."""

from dataclasses import dataclass

import numpy as np

from ..base.errors import InputError, remedy
from ..splats.splats import Splats

MOST_PIXELS = 200_000
"""Largest number of pixels along a side."""
TAGLAB_PIXELS = 32_767
"""Largest number of pixels along a side that TagLab opens: the limit of Qt's images."""
USUAL_PIXELS = 4096
"""Largest number of pixels along a side where the user chose no pixel size."""
OUTSIDE = 0.002
"""Fraction of the solid splats that may lie beyond each edge: floaters would make the map many times larger."""
SOLID = 0.1
"""Least opacity of splats that the extent is found from."""


@dataclass(frozen=True)
class MapGrid:
    """A regular grid of square pixels, row 0 at the top.

    Attributes:
        left: x of the left edge, length units of the map.
        top: y of the top edge.
        pixel: Edge of a pixel.
        width: Number of columns.
        height: Number of rows.
    """

    left: float
    top: float
    pixel: float
    width: int
    height: int

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, bottom, right and top edge."""
        return (
            self.left,
            self.top - self.pixel * self.height,
            self.left + self.pixel * self.width,
            self.top,
        )

    def places(self, heights: np.ndarray) -> np.ndarray:
        """Return x, y and height (H, W, 3) of the middles of all pixels, from their heights (H, W)."""
        x = self.left + self.pixel * (np.arange(self.width) + 0.5)
        y = self.top - self.pixel * (np.arange(self.height) + 0.5)
        return np.stack([*np.meshgrid(x, y), heights], axis=2)


def splat_size(splats: Splats) -> float:
    """Return the median of the largest standard deviation of splats: surfaces have no detail below it."""
    return float(np.median(splats.scales.max(axis=1)))


def make_grid(
    splats: Splats, pixel: float = 0.0, box: tuple[float, float, float, float] | None = None, taglab: bool = False
) -> MapGrid:
    """Lay a grid over splats in the frame of a map; its edges are multiples of the pixel size.

    Args:
        splats: The splats.
        pixel: Edge of a pixel; 0 for the median size of the splats, but no more than USUAL_PIXELS along a side.
        box: Left, bottom, right and top edge; from the splats without it.
        taglab: Whether TagLab must be able to open the map.

    Returns:
        The grid.

    Raises:
        InputError: If the pixel size or box is not valid, or there would be too many pixels.
    """
    if box is None:
        solid = splats.positions[splats.opacities >= SOLID].astype(np.float64)
        if not len(solid):
            raise InputError("The splats are all nearly transparent: there is nothing to map.")
        low, high = np.quantile(solid[:, :2], [OUTSIDE, 1 - OUTSIDE], axis=0)
        margin = splat_size(splats)
        left, bottom, right, top = low[0] - margin, low[1] - margin, high[0] + margin, high[1] + margin
    else:
        left, bottom, right, top = box
    if not (np.isfinite([left, bottom, right, top]).all() and left < right and bottom < top):
        raise InputError("A box must be left bottom right top, with left below right and bottom below top.")
    longest = max(right - left, top - bottom)
    if not pixel:
        pixel = _rounded(max(splat_size(splats), longest / USUAL_PIXELS))
    if not (np.isfinite(pixel) and pixel > 0):
        raise InputError(f"The pixel size is {pixel:g}: it must be above 0.")
    first, last = np.floor(left / pixel + 1e-6), np.ceil(top / pixel - 1e-6)
    width, height = (
        max(1, int(np.ceil(right / pixel - 1e-6) - first)),
        max(1, int(last - np.floor(bottom / pixel + 1e-6))),
    )
    most = TAGLAB_PIXELS if taglab else MOST_PIXELS
    if max(width, height) > most:
        reader = "TagLab opens" if taglab else "can be mapped"
        raise InputError(
            f"The map would have {width} x {height} pixels, more than the {most} a side that {reader}: choose a "
            f"pixel size of at least {longest / most:.2g}{remedy(', or a smaller --box', '')}."
        )
    return MapGrid(float(first * pixel), float(last * pixel), pixel, width, height)


def _rounded(value: float) -> float:
    """Round up to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= value * (1 - 1e-9)))
