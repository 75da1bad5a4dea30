"""Digital elevation models, with hillshade, slope and rugosity."""

from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import InputError, remedy
from .geotiff import NO_HEIGHT, create_map, map_crs
from .grid import MapGrid
from .heights import EDGE, surface_factor, surface_margin, surface_step, tile_heights
from .map_frame import MapScene, load_map_scene
from .ortho import describe as describe_map
from .ortho import hole_notes, map_answer
from .packages import require_packages
from .preview import write_preview
from .relief import hillshade, rugosity, slope
from .tiles import Progress, Tile, TileRenderer, tiles_of

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
    above: float | None = None,
    backend: str = "auto",
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write the heights of a run or of a splat PLY: band 1 the first surface, band 2 the median height.

    Measurements are made of band 1.

    Args:
        source: Folder of the run, or a PLY file.
        out: The GeoTIFF.
        pixel: Edge of a pixel in metres, or units where the scale is not known; chosen from the splats where it is 0.
        box: Left, bottom, right and top edge in the frame of the map.
        plane: As in `load_map_scene`.
        derived: Names of DERIVED; each becomes NAME_hillshade.tif and so on, from the first surface.
        window: Edge of the windows over which rugosity is taken.
        above: Height of the plane, in the heights of the map, above which the volume is measured; None for no volume.
        backend: What renders.
        progress: As in `make_ortho`.

    Returns:
        As `make_ortho`, with `heights`, the lowest and the highest, `rugosity`, surface over planar area of the whole
        map, and `volume` with `above`: `height` of the plane, `volume` and `area` of what lies above it.

    Raises:
        InputError: If an option or a file cannot be used.
    """
    require_packages()
    if not (np.isfinite(window) and window > 0):
        raise InputError(f"The window of rugosity is {window:g}: it must be above 0.")
    if above is not None and not np.isfinite(above):
        raise InputError(f"The height of the plane is {above:g}: {remedy('give --above a number', 'choose a number')}.")
    scene = load_map_scene(source, plane)
    scene.refuse_own(out)
    grid = scene.grid(pixel, box)
    crs = map_crs(scene)
    low, high, seen = write_heights(out, scene, grid, backend, progress)
    preview = write_preview(out, scene, grid)
    files = [out]
    for name in derived:
        path = out.with_name(f"{out.stem}_{name}.tif")
        _write_derived(path, out, name, scene, grid, window, progress)
        files.append(path)
    covered = seen / (grid.width * grid.height)
    return map_answer(out, [*files, preview], preview, grid, scene, crs) | {
        "covered": covered,
        "heights": [low, high] if seen else None,
        "rugosity": _total_rugosity(out, grid, surface_step(scene.splats, grid.pixel)),
        "volume": None if above is None else _volume_above(out, grid, above),
        "notes": [*scene.notes, *hole_notes(covered)],
    }


def write_heights(
    out: Path, scene: MapScene, grid: MapGrid, backend: str = "auto", progress: Progress | None = None
) -> tuple[float, float, int]:
    """Write the DEM of splats; return the lowest and highest first surface and the number of pixels that have one."""
    offset = scene.placement.offset[2] if scene.placement else 0.0
    renderer = TileRenderer(scene.splats, grid, backend, scene.seen)
    low, high, seen = np.inf, -np.inf, 0
    with create_map(out, scene, grid, ("first surface", "median height"), "float32", NO_HEIGHT) as writer:
        for tile in tiles_of(grid, EDGE, "Rendering heights", progress):
            heights = tile_heights(renderer, tile)
            known = heights.first[np.isfinite(heights.first)]
            if len(known):
                seen += len(known)
                low, high = min(low, float(known.min())), max(high, float(known.max()))
            bands = np.stack([heights.first, heights.median], axis=2).astype(np.float64) + offset
            writer.write(tile, np.where(np.isfinite(bands), bands, NO_HEIGHT))
    return low + offset, high + offset, seen


def read_heights(path: Path, band: int = 1, tile: Tile | None = None, margin: int = 0) -> np.ndarray:
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
    if found := document["volume"]:
        unit = document["unit"]
        lines.append(
            f"Above {found['height']:.4g} {unit}: {found['volume']:.4g} {unit}³ on {found['area']:.4g} {unit}²"
        )
    return "\n".join(lines)


def _write_derived(
    path: Path, dem: Path, name: str, scene: MapScene, grid: MapGrid, window: float, progress: Progress | None
) -> None:
    """Write hillshade (8 bits), slope (degrees) or rugosity (float32) of a DEM, tile by tile."""
    pixels = 2 * max(1, round(window / grid.pixel / 2)) + 1
    step = surface_step(scene.splats, grid.pixel)
    margin = pixels // 2 + surface_margin(step) if name == "rugosity" else 1
    dtype, nodata = ("uint8", 0.0) if name == "hillshade" else ("float32", NO_HEIGHT)
    tags = {"WINDOW": f"{pixels * grid.pixel:g}"} if name == "rugosity" else {}
    with create_map(path, scene, grid, (name,), dtype, nodata, tags=tags) as writer:
        for tile in tiles_of(grid, stage=f"Computing {name}", progress=progress):
            heights = read_heights(dem, tile=tile, margin=margin)
            if name == "hillshade":
                values = np.round(1 + 254 * hillshade(heights, grid.pixel))
            elif name == "slope":
                values = slope(heights, grid.pixel)
            else:
                values = rugosity(heights, grid.pixel, pixels, step)
            inner = values[margin : margin + tile.height, margin : margin + tile.width]
            writer.write(tile, np.where(np.isfinite(inner), inner, nodata)[..., None])


def _total_rugosity(dem: Path, grid: MapGrid, step: int) -> float | None:
    """Surface over planar area of a DEM, None where it has no surface."""
    surface, pixels, margin = 0.0, 0, surface_margin(step)
    for tile in tiles_of(grid):
        factor = surface_factor(read_heights(dem, tile=tile, margin=margin), grid.pixel, step)
        factor = factor[margin:-margin, margin:-margin]
        known = np.isfinite(factor)
        surface, pixels = surface + float(factor[known].sum()), pixels + int(known.sum())
    return surface / pixels if pixels else None


def _volume_above(dem: Path, grid: MapGrid, height: float) -> dict[str, float]:
    """Volume between a horizontal plane and the surface above it, and the area of that."""
    volume, pixels = 0.0, 0
    for tile in tiles_of(grid):
        over = read_heights(dem, tile=tile) - height
        over = over[over > 0]  # false for what was not seen
        volume, pixels = volume + float(over.sum()), pixels + len(over)
    return {"height": height, "volume": volume * grid.pixel**2, "area": pixels * grid.pixel**2}
