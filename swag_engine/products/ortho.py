"""Orthomosaics."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from ..base.files import atomic_path
from .geotiff import create_map, map_crs
from .grid import MapGrid
from .map_frame import MapScene, load_map_scene
from .packages import require_packages
from .preview import write_preview
from .tiles import SEEN, Progress, TileRenderer, tiles_of

MILLIMETRES = 1000
MOSTLY_COVERED = 0.99
"""Covered fraction of a map above which its holes are not mentioned."""
HIGHEST = 0.999
"""Quantile of the splats' heights above which a preview is shown: a few float far above."""


def make_ortho(
    source: Path,
    out: Path,
    pixel: float = 0.0,
    box: tuple[float, float, float, float] | None = None,
    plane: str = "up",
    water: float = 0.0,
    develop: str = "auto",
    taglab: bool = False,
    backend: str = "auto",
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write the orthomosaic of a run or of a splat PLY, with a preview.

    Args:
        source: Folder of the run, or a PLY file.
        out: The GeoTIFF.
        pixel: Edge of a pixel in metres, or units where the scale is not known; chosen from the splats where it is 0.
        box: Left, bottom, right and top edge in the frame of the map.
        plane: As in `load_map_scene`.
        water: How much water the colors show, 0 to 1.
        develop: Development of the colors.
        taglab: Write what TagLab opens: RGB without alpha, at most 32767 pixels a side, and a file with the pixel size.
        backend: What renders.
        progress: Called with the stage and its fraction; what it raises ends the work, and no file is left.

    Returns:
        `out`, `files`, `width`, `height`, `pixel`, `unit`, `crs`, `covered` (fraction of the pixels in which something
        was seen), `notes`, and what shows the map in its scene: `preview` (a PNG of its extent), `extent` (left,
        bottom, right, top), `top` (height of the highest splats) and `to_map` (4 x 4, from the scene to the map).

    Raises:
        InputError: If an option or a file cannot be used.
    """
    require_packages()
    scene = load_map_scene(source, plane, water, develop)
    scene.refuse_own(out)
    grid = scene.grid(pixel, box, taglab)
    crs = map_crs(scene)
    covered = write_ortho(out, scene, grid, taglab, backend, progress)
    files = [out, write_preview(out, scene, grid)]
    notes = [*scene.notes, *hole_notes(covered)]
    if not scene.north:
        notes.append("The preview has no north arrow: directions were not measured.")
    if taglab:
        files.append(write_pixel_size(out, grid, scene.unit))
        if scene.unit != "m":
            notes.append("TagLab needs millimetres per pixel, which are not known without a scale.")
    return map_answer(out, files, files[1], grid, scene, crs) | {"covered": covered, "notes": notes}


def write_ortho(
    out: Path,
    scene: MapScene,
    grid: MapGrid,
    taglab: bool = False,
    backend: str = "auto",
    progress: Progress | None = None,
) -> float:
    """Render an orthomosaic to a GeoTIFF and return the fraction of pixels in which something was seen."""
    renderer = TileRenderer(scene.splats, grid, backend, scene.seen)
    colors = renderer.colors()
    bands = ("red", "green", "blue") if taglab else ("red", "green", "blue", "alpha")
    covered = 0
    with create_map(out, scene, grid, bands, "uint8") as writer:
        for tile in tiles_of(grid, stage="Rendering colors", progress=progress):
            chosen = renderer.inside(tile)
            image, alpha = renderer.render(tile, chosen, colors[chosen])
            shown = scene.development.apply(image / np.maximum(alpha, 1e-6)[..., None])
            cover = np.clip(alpha * SEEN / scene.seen, 0, 1)[..., None]  # without alpha, black where nothing is
            shown = shown * cover if taglab else np.concatenate([shown, cover], axis=2)
            covered += int((alpha >= scene.seen).sum())
            writer.write(tile, np.round(255 * np.clip(shown, 0, 1)))
    return covered / (grid.width * grid.height)


def write_pixel_size(out: Path, grid: MapGrid, unit: str) -> Path:
    """Write the edge of a pixel in millimetres, which TagLab asks for, to a text file and return its path."""
    path = out.with_name(f"{out.stem}_pixel_size.txt")
    text = f"{grid.pixel * MILLIMETRES:.9g} mm per pixel\n" if unit == "m" else f"{grid.pixel:.9g} units per pixel\n"
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def hole_notes(covered: float) -> list[str]:
    """Say which fraction of a map shows nothing, where that is not small."""
    if covered > MOSTLY_COVERED:
        return []
    if not covered:
        return ["Nothing was seen in the map: it has no data."]
    return [f"{1 - covered:.1%} of the map shows nothing: holes have no data and are not filled."]


def map_answer(out: Path, files: list[Path], preview: Path, grid: MapGrid, scene: MapScene, crs: Any) -> dict[str, Any]:
    """Describe a map for the answer of a command."""
    known = scene.placement is not None and scene.placement.crs is not None and crs is not None
    return {
        "out": str(out),
        "files": [str(path) for path in files],
        "width": grid.width,
        "height": grid.height,
        "pixel": grid.pixel,
        "unit": scene.unit,
        "crs": scene.placement.crs if known and scene.placement else None,
        "scale_error": scene.scale_error,
        "extent": list(grid.extent),
        "preview": str(preview),
        "top": float(np.quantile(scene.splats.positions[:, 2], HIGHEST)),
        "to_map": scene.matrix.tolist(),
    }


def describe(document: dict[str, Any]) -> str:
    """Return the lines that a command prints about a map.

    Args:
        document: What `make_ortho` or `make_dem` returned.
    """
    where = document["crs"] or ("local metres" if document["unit"] == "m" else "units of the scene")
    digits = max(0, 3 - math.floor(math.log10(document["pixel"])))
    lines = [
        f"{document['out']}: {document['width']} x {document['height']} pixels of "
        f"{round(document['pixel'], digits):g} {document['unit']}, {where}, {document['covered']:.1%} covered"
    ]
    return "\n".join([*lines, *document["files"][1:], *document["notes"]])
