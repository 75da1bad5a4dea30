"""Digital elevation models, with hillshade, slope and rugosity."""

from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import InputError
from .geotiff import NO_HEIGHT, create_map, map_crs
from .grid import MapGrid, make_grid
from .heights import EDGE, gradients, surface_factor, tile_heights
from .map_frame import MapScene, load_map_scene
from .ortho import describe as describe_map
from .ortho import map_answer
from .packages import require_packages
from .tiles import Tile, TileRenderer, tiles_of

SUN_AZIMUTH = 315.0
"""Direction of the light of a hillshade, degrees from the top of the map, clockwise: the custom of maps."""
SUN_HEIGHT = 45.0
"""Height of that light above the horizon, degrees."""
WINDOW = 1.0
"""Usual edge of the windows of rugosity, metres or units."""
DERIVED = ("hillshade", "slope", "rugosity")
"""Maps that are made from heights."""


def make_dem(
    source: Path,
    out: Path,
    pixel: float = 0.0,
    box: tuple[float, float, float, float] | None = None,
    plane: str = "up",
    derived: tuple[str, ...] = (),
    window: float = WINDOW,
    backend: str = "auto",
) -> dict[str, Any]:
    """Write the heights of a run or of a splat PLY: band 1 the first surface, band 2 the median height.

    Args:
        source: Folder of the run, or a PLY file.
        out: The GeoTIFF.
        pixel: Edge of a pixel in metres, or units where the scale is not known; chosen from the splats where it is 0.
        box: Left, bottom, right and top edge in the frame of the map.
        plane: As in `load_map_scene`.
        derived: Names of DERIVED; each becomes NAME_hillshade.tif and so on, from the median height.
        window: Edge of the windows over which rugosity is taken.
        backend: What renders.

    Returns:
        As `make_ortho`, with `heights`, the lowest and the highest, and `rugosity`, surface over planar area of the
        whole map.

    Raises:
        InputError: If an option or a file cannot be used.
    """
    require_packages()
    if not (np.isfinite(window) and window > 0):
        raise InputError(f"The window of rugosity is {window:g}: it must be above 0.")
    scene = load_map_scene(source, plane)
    grid = make_grid(scene.splats, pixel, box)
    crs = map_crs(scene)
    files = [out]
    low, high, seen = write_heights(out, scene, grid, backend)
    for name in derived:
        path = out.with_name(f"{out.stem}_{name}.tif")
        _write_derived(path, out, name, scene, grid, window)
        files.append(path)
    notes = list(scene.notes)
    if not seen:
        notes.append("Nothing was seen in the map: all heights are nodata.")
    return map_answer(out, files, grid, scene, crs) | {
        "covered": seen / (grid.width * grid.height),
        "heights": [low, high] if seen else None,
        "rugosity": _total_rugosity(out, grid),
        "notes": notes,
    }


def write_heights(out: Path, scene: MapScene, grid: MapGrid, backend: str = "auto") -> tuple[float, float, int]:
    """Write the DEM of splats; return the lowest and highest median height and the number of pixels that have one."""
    offset = scene.placement.offset[2] if scene.placement else 0.0
    renderer = TileRenderer(scene.splats, grid, backend)
    low, high, seen = np.inf, -np.inf, 0
    with create_map(out, scene, grid, ("first surface", "median height"), "float32", NO_HEIGHT) as writer:
        for tile in tiles_of(grid, EDGE):
            heights = tile_heights(renderer, tile)
            known = heights.median[np.isfinite(heights.median)]
            if len(known):
                seen += len(known)
                low, high = min(low, float(known.min())), max(high, float(known.max()))
            bands = np.stack([heights.first, heights.median], axis=2).astype(np.float64) + offset
            writer.write(tile, np.where(np.isfinite(bands), bands, NO_HEIGHT))
    return low + offset, high + offset, seen


def read_heights(path: Path, band: int = 2, tile: Tile | None = None, margin: int = 0) -> np.ndarray:
    """Read heights of a DEM, NaN where there are none.

    Args:
        path: The DEM.
        band: 1 for the first surface, 2 for the median height.
        tile: The part to read; all without it.
        margin: Pixels around the tile that are read, too; NaN beyond the edges of the map.
    """
    rasterio = require_packages()
    from rasterio.windows import Window

    window = None
    if tile is not None:
        window = Window(tile.column - margin, tile.row - margin, tile.width + 2 * margin, tile.height + 2 * margin)
    with rasterio.open(path) as dataset:
        values = dataset.read(band, window=window, boundless=window is not None, fill_value=NO_HEIGHT)
    return np.where(values == NO_HEIGHT, np.nan, values.astype(np.float64))


def hillshade(heights: np.ndarray, pixel: float) -> np.ndarray:
    """Shade heights (H, W) as a matt surface in parallel light, 0 to 1, NaN where nothing was seen."""
    down, right = gradients(heights, pixel)
    azimuth, elevation = np.radians(SUN_AZIMUTH), np.radians(SUN_HEIGHT)
    light = np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)
    # The normal is (-dz/dx, -dz/dy, 1) and y goes up where rows go down.
    shade = (-right * light[0] + down * light[1] + light[2]) / np.sqrt(1 + right * right + down * down)
    return np.clip(shade, 0, 1)


def slope(heights: np.ndarray, pixel: float) -> np.ndarray:
    """Return the steepness of heights (H, W) in degrees, NaN where nothing was seen."""
    down, right = gradients(heights, pixel)
    return np.degrees(np.arctan(np.hypot(down, right)))


def rugosity(heights: np.ndarray, pixel: float, window: int) -> np.ndarray:
    """Return surface over planar area in a window around each pixel, NaN where nothing was seen.

    Args:
        heights: (H, W), NaN where nothing was seen.
        pixel: Edge of a pixel.
        window: Edge of the window, an odd number of pixels.
    """
    import cv2

    factor = surface_factor(heights, pixel)
    known = np.isfinite(factor)
    size = window, window
    sums = cv2.boxFilter(
        np.where(known, factor, 0.0), cv2.CV_64F, size, normalize=False, borderType=cv2.BORDER_CONSTANT
    )
    counts = cv2.boxFilter(known.astype(np.float64), cv2.CV_64F, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
    return np.where(known, sums / np.maximum(counts, 1), np.nan)


def describe(document: dict[str, Any]) -> str:
    """Return the lines that the command `dem` prints.

    Args:
        document: What `make_dem` returned.
    """
    lines = [describe_map(document)]
    if document["heights"]:
        low, high = document["heights"]
        lines.append(
            f"Heights {low:.4g} to {high:.4g} {document['unit']}, surface over planar area {document['rugosity']:.3f}"
        )
    return "\n".join(lines)


def _write_derived(path: Path, dem: Path, name: str, scene: MapScene, grid: MapGrid, window: float) -> None:
    """Write hillshade (8 bits), slope (degrees) or rugosity (float32) of a DEM, tile by tile."""
    pixels = 2 * max(1, round(window / grid.pixel / 2)) + 1
    margin = pixels // 2 + 1 if name == "rugosity" else 1
    dtype, nodata = ("uint8", 0.0) if name == "hillshade" else ("float32", NO_HEIGHT)
    tags = {"WINDOW": f"{pixels * grid.pixel:g}"} if name == "rugosity" else {}
    with create_map(path, scene, grid, (name,), dtype, nodata, tags=tags) as writer:
        for tile in tiles_of(grid):
            heights = read_heights(dem, tile=tile, margin=margin)
            if name == "hillshade":
                values = np.round(1 + 254 * hillshade(heights, grid.pixel))
            elif name == "slope":
                values = slope(heights, grid.pixel)
            else:
                values = rugosity(heights, grid.pixel, pixels)
            inner = values[margin : margin + tile.height, margin : margin + tile.width]
            writer.write(tile, np.where(np.isfinite(inner), inner, nodata)[..., None])


def _total_rugosity(dem: Path, grid: MapGrid) -> float | None:
    """Surface over planar area of a DEM, None where it has no surface."""
    surface, pixels = 0.0, 0
    for tile in tiles_of(grid):
        factor = surface_factor(read_heights(dem, tile=tile, margin=1), grid.pixel)[1:-1, 1:-1]
        known = np.isfinite(factor)
        surface, pixels = surface + float(factor[known].sum()), pixels + int(known.sum())
    return surface / pixels if pixels else None
