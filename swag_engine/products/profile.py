"""Heights along a line."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import InputError, remedy
from ..base.files import atomic_path, write_csv
from ..base.isolation import import_matplotlib
from .dem import read_heights, write_heights
from .geotiff import map_crs
from .grid import USUAL_PIXELS, MapGrid, make_grid, splat_size
from .heights import smoothed, surface_margin, surface_step
from .map_frame import load_map_scene
from .packages import require_packages
from .tiles import Progress

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_STEPS = 100_000


def make_profile(
    source: Path,
    line: tuple[float, ...],
    out: Path,
    pixel: float = 0.0,
    plane: str = "up",
    backend: str = "auto",
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write the heights of a run or of a splat PLY along a straight line, as a table and a picture.

    Args:
        source: Folder of the run, or a PLY file.
        line: x and y of the first and of the last point, in the frame of the map without the offset of its system; or
            x, y and z of both in the coordinates of the scene.
        out: The CSV file; NAME.png is the picture.
        pixel: Distance between heights; chosen from the splats and the line where it is 0.
        plane: As in `load_map_scene`.
        backend: What renders.
        progress: As in `make_ortho`.

    Returns:
        `out`, `files`, `unit`, `length` (planar), `surface_length` (along the surface where it was seen), `rugosity`
        (surface over planar length of what was seen), `heights` (lowest and highest, None where nothing was seen),
        `covered`, `notes`, `to_map` (4 x 4, from the scene to the map) and `curve` (x, y, height in the map).

    Raises:
        InputError: If an option or a file cannot be used.
    """
    require_packages()
    if out.suffix.lower() != ".csv":
        raise InputError(f"{out.name} is no table: choose a name that ends in .csv.")
    scene = load_map_scene(source, plane)
    scene.refuse_own(out, out.with_suffix(".png"))
    if len(line) == 6:
        ends = np.reshape(np.array(line, np.float64), (2, 3)) @ scene.matrix[:3, :3].T + scene.matrix[:3, 3]
    else:
        ends = scene.without_offset(line)
    start, end = ends[:, :2]
    length = float(np.linalg.norm(end - start))
    if not (np.isfinite(length) and length > 0):
        raise InputError(f"The line of the profile needs two different points{remedy(', as --line x y x y', '')}.")
    map_crs(scene)
    pixel = pixel or max(splat_size(scene.splats), length / USUAL_PIXELS)
    step = surface_step(scene.splats, pixel)
    margin = surface_margin(step) * pixel  # around the line
    low, high = np.minimum(start, end) - margin, np.maximum(start, end) + margin
    grid = make_grid(scene.splats, pixel, (low[0], low[1], high[0], high[1]))
    if length / pixel > MOST_STEPS:
        raise InputError(
            f"The line would have {length / pixel:.0f} heights, more than {MOST_STEPS}: choose a larger pixel."
        )
    with TemporaryDirectory() as folder:
        dem = Path(folder) / "dem.tif"
        write_heights(dem, scene, grid, backend, progress)
        bands = [read_heights(dem, band) for band in (1, 2)]
    distances = np.linspace(0, length, max(2, round(length / pixel) + 1))
    places = start + distances[:, None] / length * (end - start)
    first, median = (sample(band, grid, places) for band in bands)
    offset, height_offset = np.zeros(2), 0.0
    if scene.placement:
        offset, height_offset = np.array(scene.placement.offset[:2]), scene.placement.offset[2]
    _write_table(out, distances, places + offset, first, median)
    picture = out.with_suffix(".png")
    with atomic_path(picture) as temporary:
        _plot(distances, first, median, scene.unit).savefig(temporary, format="png", dpi=120)
    step = min(step, len(distances) - 1)
    level = sample(smoothed(bands[0], step), grid, places)
    run, rise = distances[step:] - distances[:-step], level[step:] - level[:-step]
    known = np.isfinite(rise)
    rugosity = float(np.hypot(run, rise)[known].sum() / run[known].sum()) if known.any() else None
    # Parts of the line that are seen in heights one after another.
    planar = float(np.diff(distances)[np.isfinite(np.diff(level))].sum())
    seen = np.isfinite(first)
    return {
        "out": str(out),
        "files": [str(out), str(picture)],
        "unit": scene.unit,
        "length": length,
        "surface_length": (rugosity or 1.0) * planar,
        "rugosity": rugosity,
        "heights": [float(first[seen].min()), float(first[seen].max())] if seen.any() else None,
        "covered": float(seen.mean()),
        "scale_error": scene.scale_error,
        "notes": list(scene.notes),
        "to_map": scene.matrix.tolist(),
        "curve": np.column_stack([places, first - height_offset])[seen].tolist(),
    }


def sample(heights: np.ndarray, grid: MapGrid, places: np.ndarray) -> np.ndarray:
    """Interpolate heights (H, W) at places (M, 2) linearly; NaN where one of the four pixels around has none."""
    columns = ((places[:, 0] - grid.left) / grid.pixel - 0.5).astype(np.float32)
    rows = ((grid.top - places[:, 1]) / grid.pixel - 0.5).astype(np.float32)
    height, width = heights.shape
    left, top = np.floor(columns).astype(int), np.floor(rows).astype(int)
    x, y = columns - left, rows - top
    left, top = np.clip(left, 0, max(width - 2, 0)), np.clip(top, 0, max(height - 2, 0))
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    upper = (1 - x) * heights[top, left] + x * heights[top, right]
    lower = (1 - x) * heights[bottom, left] + x * heights[bottom, right]
    return (1 - y) * upper + y * lower


def describe(document: dict[str, Any]) -> str:
    """Return the lines that the command `profile` prints.

    Args:
        document: What `make_profile` returned.
    """
    unit = document["unit"]
    lines = [f"{document['out']}: {document['length']:.4g} {unit}, {document['covered']:.1%} covered"]
    if document["heights"] and document["rugosity"]:
        low, high = document["heights"]
        lines.append(
            f"Heights {low:.4g} to {high:.4g} {unit}, {document['surface_length']:.4g} {unit} along the surface "
            f"(rugosity {document['rugosity']:.3f})"
        )
    return "\n".join([*lines, *document["files"][1:], *document["notes"]])


def _write_table(out: Path, distances: np.ndarray, places: np.ndarray, first: np.ndarray, median: np.ndarray) -> None:
    rows = []
    for distance, (x, y), top, middle in zip(distances, places, first, median, strict=True):
        heights = ["" if np.isnan(value) else f"{value:.6g}" for value in (top, middle)]
        rows.append([f"{distance:.6g}", f"{x:.10g}", f"{y:.10g}", *heights])
    write_csv(out, ["distance", "x", "y", "first_surface", "median_height"], rows)


def _plot(distances: np.ndarray, first: np.ndarray, median: np.ndarray, unit: str) -> "Figure":
    import_matplotlib()
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3), layout="constrained")
    axes = figure.add_subplot()
    axes.plot(distances, median, color="0.7", linewidth=1, label="median height")
    axes.plot(distances, first, color="black", linewidth=1, label="first surface")
    axes.set(xlabel=f"distance [{unit}]", ylabel=f"height [{unit}]")
    axes.legend(frameon=False)
    return figure
