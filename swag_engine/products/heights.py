"""Heights from splats: the first surface, and the median height of what absorbs the light."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ..splats.splats import Splats
from .grid import splat_size
from .tiles import Tile, TileRenderer

LAYERS = 32
"""Layers of equal thickness in a tile. The height is the mean over the layer with the threshold and its neighbours:
with 16 layers the median error of trained surveys is 0.5 pixels instead of 0.2 (benchmarks/products.py)."""
FIRST = 0.2
"""Absorbed fraction of the light, relative to alpha, at which the first surface is. Ground of fine texture is often
learned as small splats over smooth ones some centimetres below it: of 0.05 to 0.5, this has the least error on trained
surveys (benchmarks/products.py), and haze of less opacity does not count."""
UNCERTAIN = 0.05, 0.4
"""Absorbed fractions between whose heights neighbours decide where the first surface is. Without them one pixel in 25
of trained surveys in water is a pit, and the 95 % quantile of errors is twice as large (benchmarks/products.py)."""
MOST_APART = 16
"""Largest distance of these neighbours, pixels: tiles are rendered with a margin of twice that at most."""
MEDIAN = 0.5
"""Absorbed fraction at the median height."""
OUTLIERS = 1e-3
"""Fraction of a tile's splats above and below the layers, which the outer ones take in."""
SMOOTHING = 5
"""Edge of the median filter before surfaces are measured, heights: noise counts as surface. At a pixel of 1 cm it makes
a surplus of 18 to 50 % on the sand of trained surveys one of 10 to 14 % (benchmarks/products.py)."""
MOST_STEP = 64
"""Largest size of splats at which a surface is measured, pixels: tiles are read with a margin of three sizes."""
EDGE = 256
"""Edge of the tiles in which heights are found, pixels: 4 LAYERS channels are blended at once (34 MB)."""


@dataclass(frozen=True, eq=False)
class TileHeights:
    """Heights of a tile, NaN where nothing was seen.

    Attributes:
        first: (height, width) the first surface from above.
        median: (height, width) where half of the light is absorbed.
    """

    first: np.ndarray
    median: np.ndarray


def tile_heights(renderer: TileRenderer, tile: Tile) -> TileHeights:
    """Find the heights of a tile.

    Splats are sorted into layers by the height of their centres; of each layer the absorbed light is blended, and that
    times the height of the splats' ridges (`TileRenderer.slopes`), which is linear in x and y. The first surface is
    then moved to the median of its neighbours, as far as the layers leave it UNCERTAIN.

    Args:
        renderer: Of the splats.
        tile: At most EDGE pixels wide and high.
    """
    step = min(surface_step(renderer.splats, renderer.grid.pixel), MOST_APART)
    margin = step * (SMOOTHING // 2)
    wider = Tile(tile.column - margin, tile.row - margin, tile.width + 2 * margin, tile.height + 2 * margin)
    highest, lowest, first, median = _heights_at(renderer, wider, (*UNCERTAIN, FIRST, MEDIAN))
    # Each is a mean over layers of its own, so that they may be out of order by a part of a layer.
    low, high = np.minimum(lowest, first), np.maximum(highest, first)
    inner = slice(margin, margin + tile.height), slice(margin, margin + tile.width)
    return TileHeights(np.clip(smoothed(first, step), low, high)[inner].astype(np.float32), median[inner])


def _heights_at(renderer: TileRenderer, tile: Tile, fractions: Sequence[float]) -> list[np.ndarray]:
    """Return the heights (height, width) at which these fractions of the light are absorbed, relative to alpha."""
    chosen = renderer.inside(tile)
    if not len(chosen):
        return [np.full((tile.height, tile.width), np.nan, np.float32) for _ in fractions]
    grid = renderer.grid
    middle_x = grid.left + grid.pixel * (tile.column + tile.width / 2)
    middle_y = grid.top - grid.pixel * (tile.row + tile.height / 2)
    positions = renderer.splats.positions[chosen].astype(np.float64)
    x, y, z = positions[:, 0] - middle_x, positions[:, 1] - middle_y, positions[:, 2]
    low, high = np.quantile(z, [OUTLIERS, 1 - OUTLIERS])
    reference = (low + high) / 2
    thickness = max((high - low) / LAYERS, 1e-12)
    layers = np.clip(((high - z) / thickness).astype(np.int64), 0, LAYERS - 1)  # the highest first
    slopes = renderer.slopes[chosen]
    values = np.stack([np.ones(len(z)), z - reference - slopes[:, 0] * x - slopes[:, 1] * y, *slopes.T], axis=1)
    channels = np.zeros((len(chosen), LAYERS, 4), np.float32)
    channels[np.arange(len(chosen)), layers] = values
    blended, alpha = renderer.render(tile, chosen, channels.reshape(len(chosen), 4 * LAYERS))
    blended = blended.reshape(tile.height, tile.width, LAYERS, 4)
    column = grid.pixel * (np.arange(tile.width) + 0.5 - tile.width / 2)
    row = -grid.pixel * (np.arange(tile.height) + 0.5 - tile.height / 2)
    absorbed = blended[..., 0]
    heights = blended[..., 1] + column[None, :, None] * blended[..., 2] + row[:, None, None] * blended[..., 3]
    fraction = np.cumsum(absorbed, axis=2) / np.maximum(alpha, 1e-6)[..., None]
    found = []
    for threshold in fractions:
        at = np.argmax(fraction >= threshold - 1e-6, axis=2)
        total, weight = np.zeros(alpha.shape), np.zeros(alpha.shape)
        for step in (-1, 0, 1):
            layer = np.clip(at + step, 0, LAYERS - 1)[..., None]
            counts = (at + step >= 0) & (at + step < LAYERS)
            weight += counts * np.take_along_axis(absorbed, layer, axis=2)[..., 0]
            total += counts * np.take_along_axis(heights, layer, axis=2)[..., 0]
        height = reference + total / np.maximum(weight, 1e-9)
        found.append(np.where(alpha >= renderer.seen, height, np.nan).astype(np.float32))
    return found


def surface_step(splats: Splats, pixel: float) -> int:
    """Return the size of the splats in pixels, at which surfaces are measured whatever the pixel is.

    Nearer heights are of the same splats and differ by noise, which would count as more surface the smaller pixels are.
    """
    return int(np.clip(round(splat_size(splats) / pixel), 1, MOST_STEP))


def surface_margin(step: int) -> int:
    """Return how many pixels around a pixel its surface depends on."""
    return step * (SMOOTHING // 2 + 1)


def surface_factor(heights: np.ndarray, pixel: float, step: int = 1, regions: np.ndarray | None = None) -> np.ndarray:
    """Return surface area over planar area of each pixel, sqrt(1 + |gradient|^2), NaN where it is not known.

    Heights are smoothed, and slopes are differences over a splat: each pixel depends on `surface_margin(step)`
    pixels around it.

    Args:
        heights: (H, W), NaN where nothing was seen.
        pixel: Edge of a pixel, in the unit of the heights.
        step: As `surface_step` returns it.
        regions: (H, W) numbers; steps between regions are not slopes of either.
    """
    down, right = gradients(smoothed(heights, step), pixel, (step + 1) // 2, regions)
    return np.sqrt(1 + down * down + right * right)


def smoothed(heights: np.ndarray, step: int = 1) -> np.ndarray:
    """Return heights (H, W) after a median filter over SMOOTHING x SMOOTHING heights that are `step` pixels apart.

    Beside holes, and in them, they stay.
    """
    holes = np.isnan(heights)
    values = np.where(holes, 0, heights).astype(np.float32)
    filtered, beside = np.empty_like(values), np.empty(holes.shape, bool)
    for part in ((slice(row, None, step), slice(column, None, step)) for row in range(step) for column in range(step)):
        if values[part].size:
            filtered[part] = cv2.medianBlur(np.ascontiguousarray(values[part]), SMOOTHING)
            beside[part] = cv2.dilate(holes[part].astype(np.uint8), np.ones((SMOOTHING, SMOOTHING), np.uint8)) > 0
    return np.where(beside, heights, filtered)


def gradients(
    heights: np.ndarray, pixel: float, step: int = 1, regions: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Differentiate heights (H, W) by rows and by columns: central differences, one-sided beside holes and edges.

    Neighbours are `step` pixels away. Those in another region, where `regions` (H, W) are given, count as holes.
    """
    results = []
    for axis in (0, 1):
        before, after = _neighbours(heights, axis, step)
        if regions is not None:
            other_before, other_after = _neighbours(regions.astype(np.float64), axis, step)
            before = np.where(other_before == regions, before, np.nan)
            after = np.where(other_after == regions, after, np.nan)
        slopes = (after - before) / (2 * step * pixel)
        slopes = np.where(np.isnan(slopes), (after - heights) / (step * pixel), slopes)
        slopes = np.where(np.isnan(slopes), (heights - before) / (step * pixel), slopes)
        results.append(np.where(np.isnan(heights), np.nan, slopes))
    return results[0], results[1]


def _neighbours(values: np.ndarray, axis: int, step: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the values `step` pixels before and after each pixel along an axis, NaN beyond the edges."""
    padded = np.pad(values, [(step, step) if a == axis else (0, 0) for a in (0, 1)], constant_values=np.nan)
    size = values.shape[axis]
    return np.take(padded, range(size), axis=axis), np.take(padded, range(2 * step, size + 2 * step), axis=axis)
