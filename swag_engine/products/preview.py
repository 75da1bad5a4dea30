"""Previews of maps: small PNG files with a scale bar, a legend, and an arrow to the north where that is known."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ..base.files import atomic_path
from .geotiff import Color
from .grid import MapGrid
from .map_frame import MapScene
from .packages import require_packages
from .relief import hillshade

PREVIEW = 1600
"""Largest edge of a preview, pixels; smaller maps are enlarged by a whole factor, so that the legend can be read."""
STRETCH = (2, 98)
"""Percentiles of the heights that have the first and the last color."""
HEIGHTS = 5
"""Heights in the legend."""
WHITE = 255
Legend = list[tuple[str, Color]]


def write_preview(path: Path, scene: MapScene, grid: MapGrid) -> Path:
    """Write the preview of a map beside it; it is transparent where nothing was seen.

    A map of colors is shown as it is, one with a palette in the colors of that, heights in colors with their shading.

    Args:
        path: The map.
        scene: What it shows.
        grid: Its pixels.

    Returns:
        The file, NAME_preview.png.
    """
    rasterio = require_packages()
    from rasterio.enums import ColorInterp, Resampling

    factor = PREVIEW / max(grid.width, grid.height)
    factor = max(1, int(factor)) if factor >= 1 else factor
    shape = max(1, round(grid.height * factor)), max(1, round(grid.width * factor))
    pixel = grid.pixel * grid.width / shape[1]
    with rasterio.open(path) as dataset:
        palette = dataset.colorinterp[0] == ColorInterp.palette
        smooth = Resampling.bilinear if factor > 1 else Resampling.average
        method = Resampling.nearest if palette else smooth
        values: Any = np.moveaxis(
            dataset.read(out_shape=(dataset.count, *shape), resampling=method, masked=True), 0, -1
        )
        if palette:
            image, legend = _palette_image(values[..., 0], dataset.colormap(1), dataset.tags())
        elif dataset.dtypes[0] == "uint8":
            image, legend = _color_image(np.asarray(values.data)), []
        else:
            image, legend = _height_image(np.ma.filled(values[..., 0].astype(np.float64), np.nan), pixel, scene.unit)
    image = np.ascontiguousarray(image)
    _draw_legend(image, legend)
    draw_scale(image, pixel, scene.unit, scene.north)
    out = path.with_name(f"{path.stem}_preview.png")
    write_png(out, cv2.cvtColor(image, cv2.COLOR_RGBA2BGRA))
    return out


def _color_image(bands: np.ndarray) -> np.ndarray:
    """An image (H, W, 4) of three or four bands, white where it is transparent."""
    if bands.shape[2] == 3:
        return np.dstack([bands, np.full(bands.shape[:2], 255, np.uint8)])
    cover = bands[..., 3:] / 255
    return np.dstack([np.round(bands[..., :3] * cover + WHITE * (1 - cover)).astype(np.uint8), bands[..., 3]])


def _palette_image(values: Any, colors: dict[int, tuple[int, ...]], tags: dict[str, str]) -> tuple[np.ndarray, Legend]:
    """An image (H, W, 4) of values with a palette, and the names of those that it shows."""
    table = np.array([colors[value][:3] for value in range(256)], np.uint8)
    alpha = np.where(np.ma.getmaskarray(values), 0, 255).astype(np.uint8)
    image = np.where(alpha[..., None] > 0, table[values.data], WHITE).astype(np.uint8)
    names = {int(key.rpartition("_")[2]): name for key, name in tags.items() if key.startswith(("LABEL_", "VALUE_"))}
    shown = np.unique(values.compressed()).tolist()
    return np.dstack([image, alpha]), [
        (names[value], tuple(table[value].tolist())) for value in shown if value in names
    ]


def _height_image(heights: np.ndarray, pixel: float, unit: str) -> tuple[np.ndarray, Legend]:
    """An image (H, W, 4) of heights, and heights from the last color to the first."""
    known = np.isfinite(heights)
    if not known.any():
        return np.dstack([np.full((*heights.shape, 3), WHITE, np.uint8), np.zeros(heights.shape, np.uint8)]), []
    low, high = np.percentile(heights[known], STRETCH)
    ramp = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_VIRIDIS)[:, 0, ::-1]
    level = np.clip((np.where(known, heights, low) - low) / max(high - low, 1e-12), 0, 1)
    shade = np.nan_to_num(hillshade(heights, pixel), nan=1.0)[..., None]
    image = np.round(ramp[np.round(255 * level).astype(np.uint8)] * (0.4 + 0.6 * shade))
    image[~known] = WHITE
    digits = max(0, 1 - int(np.floor(np.log10(max(high - low, 1e-9)))))
    legend: Legend = [
        (f"{low + at * (high - low):.{digits}f} {unit}", tuple(ramp[round(255 * at)].tolist()))
        for at in np.linspace(1, 0, HEIGHTS)
    ]
    return np.dstack([image.astype(np.uint8), np.where(known, 255, 0).astype(np.uint8)]), legend


def write_png(path: Path, image: np.ndarray) -> None:
    """Write an image (H, W), (H, W, 3) or (H, W, 4) in the order of OpenCV."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(cv2.imencode(".png", image)[1].tobytes())


def draw_scale(image: np.ndarray, pixel: float, unit: str, north: bool) -> None:
    """Draw a scale bar, and an arrow to the north, into an image.

    Args:
        image: (H, W, 4) uint8, changed in place.
        pixel: Edge of its pixels, length units.
        unit: Name of the length unit.
        north: Whether the top is north.
    """
    height, width = image.shape[:2]
    power = 10.0 ** np.floor(np.log10(max(width * pixel / 4, 1e-30)))
    length = float(max(step * power for step in (1, 2, 5) if step * power <= width * pixel / 4 + 1e-12))
    bar, margin, size = max(1, round(length / pixel)), max(2, width // 40), _size(image)
    y = height - margin
    _draw_text(image, f"{length:g} {unit}", (margin, y - round(10 * size)), (WHITE, WHITE, WHITE))
    if north:
        _draw_text(image, "N", (width - margin - round(9 * size), 4 * margin), (WHITE, WHITE, WHITE))
    for level, thickness in ((0, 5), (WHITE, 2)):
        color, thick = (level, level, level, 255), max(1, round(thickness * size))
        cv2.line(image, (margin, y), (margin + bar, y), color, thick)
        if north:
            top = width - margin, margin
            cv2.arrowedLine(image, (top[0], 3 * margin), top, color, thick, tipLength=0.3)


def _draw_legend(image: np.ndarray, legend: Legend) -> None:
    """Draw squares of colors with their names, from the upper left corner of an image (H, W, 4) down."""
    margin, size = max(2, image.shape[1] // 40), _size(image)
    edge = max(2, round(24 * size))
    for row, (name, color) in enumerate(legend):
        top = margin + round(34 * row * size)
        corners = (margin, top), (margin + edge, top + edge)
        cv2.rectangle(image, *corners, (*color, 255), cv2.FILLED)
        cv2.rectangle(image, *corners, (0, 0, 0, 255), max(1, round(2 * size)))
        _draw_text(image, name, (margin + round(1.4 * edge), top + edge), (WHITE, WHITE, WHITE))


def _draw_text(image: np.ndarray, text: str, place: tuple[int, int], color: Color) -> None:
    """Write a text with a black outline into an image (H, W, 4); OpenCV's fonts have ASCII characters alone."""
    size = _size(image)
    plain = text.encode("ascii", "replace").decode()
    # OpenCV 5 has other fonts than OpenCV 4: it blends the edges, also in the alpha channel, and has no thick strokes.
    mask = np.zeros(image.shape[:2], np.uint8)
    cv2.putText(mask, plain, place, cv2.FONT_HERSHEY_SIMPLEX, 0.8 * size, [255], max(1, round(2 * size)))
    outline = cv2.dilate(mask, np.ones((3, 3), np.uint8), iterations=max(1, round(1.5 * size)))
    for pixels, shade in ((outline, (0, 0, 0)), (mask, color)):
        seen = pixels > 0
        weight = pixels[seen, None] / 255
        image[seen] = np.round(image[seen] * (1 - weight) + np.array([*shade, 255]) * weight)


def _size(image: np.ndarray) -> float:
    """Size of what is drawn into an image, 1 for the largest previews."""
    return max(0.3, image.shape[1] / PREVIEW)
