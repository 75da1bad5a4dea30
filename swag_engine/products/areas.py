"""Areas by label: a label map, a table with errors, and polygons."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import DAMAGE, InputError, remedy
from ..base.files import write_csv
from ..formats.ply import read_ply
from ..formats.run_folder import RunFolder, read_json, write_json
from ..formats.select import LABEL
from ..semantics.labels import TABLE
from .dem import read_heights, write_heights
from .geotiff import NO_LABEL, map_crs, map_transform, read_map
from .grid import MapGrid
from .heights import surface_factor, surface_margin, surface_step
from .label_errors import area_errors, held_out_confusion
from .label_map import (
    CorrectedMap,
    corrected_splats,
    label_colors,
    label_name,
    splat_labels,
    write_label_map,
)
from .map_frame import MapScene, load_map_scene
from .ortho import hole_notes, map_answer
from .packages import require_packages
from .patches import Patch, find_patches, to_coco, to_geojson
from .preview import write_preview
from .tiles import Progress, tiles_of

LEAST_PATCH = 10
"""Smallest number of pixels of a patch that is counted: smaller ones are mostly noise at edges."""
QUANTILES = {"patch_p10": 0.1, "patch_median": 0.5, "patch_p90": 0.9}
"""Columns of the size distribution, with their quantiles."""
FILES = {
    "labels": "labels.tif",
    "heights": "heights.tif",
    "table": "areas.csv",
    "polygons": "patches.geojson",
    "coco": "patches_coco.json",
    "answer": "areas.json",
}
"""Files in the folder of areas."""


def make_areas(
    source: Path,
    out: Path,
    pixel: float = 0.0,
    box: tuple[float, float, float, float] | None = None,
    plane: str = "up",
    masks: Path | None = None,
    least_patch: int = LEAST_PATCH,
    corrected: Path | None = None,
    backend: str = "auto",
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write the label map of a labelled run, the areas of its labels with errors, and its patches.

    Args:
        source: Folder of the run, or a PLY file with labels.
        out: Folder of the files in FILES.
        pixel: Edge of a pixel in metres, or units where the scale is not known; chosen from the splats where it is 0.
        box: Left, bottom, right and top edge in the frame of the map.
        plane: As in `load_map_scene`.
        masks: Folder of masks of test images, from which errors are found; `labels` of the scene without it.
        least_patch: Smallest number of pixels of a patch.
        corrected: Corrected copy of the label map in `out`; its labels go to the splats of the run before the files are
            made again, with the pixels that they had.
        backend: What renders.
        progress: As in `make_ortho`.

    Returns:
        As `make_ortho`; `labels`, a dict with the columns of the table each; `held_out`, the number of images that the
        errors are from; `changed_splats`, how many got another label, None without `corrected`; `grid` and `plane`.

    Raises:
        InputError: If there are no labels, or an option or a file cannot be used.
    """
    require_packages()
    if least_patch < 1:
        raise InputError(f"The smallest patch is {least_patch} pixels: it must have at least 1.")
    changed, made = None, None
    if corrected:
        changed, made, plane = correct_labels(source, out, corrected, backend, progress)
    scene = load_map_scene(source, plane)
    splat_labels(scene.splats)
    grid = made or scene.grid(pixel, box)
    crs = map_crs(scene)
    files = {name: out / file for name, file in FILES.items()}
    pixels = write_label_map(files["labels"], scene, grid, backend, progress)
    write_heights(files["heights"], scene, grid, backend, progress)
    present = sorted({*scene.labels, *np.flatnonzero(pixels[:NO_LABEL]).tolist()})
    names = {label: label_name(scene, label) for label in present}
    confusion = held_out_confusion(scene, masks, files["labels"], files["heights"], grid)
    patches = find_patches(files["labels"], least_patch)
    surfaces = _surfaces(files["labels"], files["heights"], grid, surface_step(scene.splats, grid.pixel))
    rows = _table(scene, grid, pixels[:NO_LABEL], surfaces, names, confusion, patches)
    _write_table(files["table"], rows)
    transform = map_transform(scene, grid)
    write_json(files["polygons"], to_geojson(patches, transform, crs, grid.pixel, names))
    write_json(files["coco"], to_coco(patches, FILES["labels"], grid.width, grid.height, names))
    covered = int(pixels[:NO_LABEL].sum()) / int(pixels.sum())
    notes = [*scene.notes, *hole_notes(covered), *_error_notes(confusion, rows, scene)]
    notes += [f"No pixel shows the label {row['name']}." for row in rows if not row["pixels"]]
    preview = write_preview(files["labels"], scene, grid)
    answer = map_answer(out, [*files.values(), preview], preview, grid, scene, crs) | {
        "covered": covered,
        "plane": plane,
        "grid": vars(grid),
        "held_out": len(confusion),
        "changed_splats": changed,
        "labels": rows,
        "notes": notes,
    }
    write_json(files["answer"], answer)
    return answer


def correct_labels(
    folder: Path, areas: Path, corrected: Path, backend: str = "auto", progress: Progress | None = None
) -> tuple[int, MapGrid, str]:
    """Give the splats of a run the labels of a corrected label map, and write its result files.

    Args:
        folder: Folder of the run.
        areas: Folder that `make_areas` wrote.
        corrected: The corrected label map.
        backend: What renders.
        progress: As in `make_ortho`.

    Returns:
        Number of splats that have another label now, and grid and plane of the label map.

    Raises:
        InputError: If the corrected map cannot be used, or the run was labelled again since.
    """
    require_packages()
    run = RunFolder(folder)
    run.read_config()
    how = remedy("make them first, without --corrected", "empty Corrected Labels and press Areas by Label first")
    document = read_json(areas / FILES["answer"], f"{areas} holds no areas: {how}.")
    try:
        grid, plane = MapGrid(**document["grid"]), str(document["plane"])
    except DAMAGE as error:
        raise InputError(f"{areas / FILES['answer']} is damaged: make the areas again.") from error
    scene = load_map_scene(folder, plane)
    colors = label_colors([0, *sorted({*scene.labels, *splat_labels(scene.splats).tolist()})])
    painted = CorrectedMap(corrected, areas / FILES["labels"], grid, colors)
    labels = corrected_splats(scene, painted, backend, progress).astype(np.int32)
    splats = read_ply(run.ply)
    changed = int((labels != splats.extras[LABEL]).sum())
    if changed:
        _, _, up = run.read_config()
        run.write_result(replace(splats, extras=splats.extras | {LABEL: labels}), up)
        _update_counts(run.path / TABLE, labels)
    return changed, grid, plane


def describe(document: dict[str, Any]) -> str:
    """Return the lines that the command `areas` prints.

    Args:
        document: What `make_areas` returned.
    """
    square = f"{document['unit']}²"
    lines = []
    if document["changed_splats"] is not None:
        lines.append(f"{document['changed_splats']} splats have another label now.")
    lines += [
        f"{'label':<20} {'planar ' + square:>12} {'95 %':>25} {'surface ' + square:>14} {'cover':>7} {'patches':>8}"
    ]
    for row in document["labels"]:
        interval = f"{row['planar_low']:.4g} to {row['planar_high']:.4g}"
        lines.append(
            f"{row['name']:<20} {row['planar_area']:>12.4g} {interval:>25} {row['surface_area']:>14.4g} "
            f"{row['cover_percent']:>6.2f}% {row['patches']:>8}"
        )
    return "\n".join([*lines, *document["files"], *document["notes"]])


def _table(
    scene: MapScene,
    grid: MapGrid,
    pixels: np.ndarray,
    surfaces: np.ndarray,
    names: dict[int, str],
    confusion: np.ndarray,
    patches: list[Patch],
) -> list[dict[str, Any]]:
    """Make the rows of the table from the pixels (255,) and surfaces (255,) of each label."""
    square = grid.pixel**2
    size = max([*names, confusion.shape[1] - 1]) + 1
    pixels = pixels[:size]
    if len(confusion) and confusion.shape[1] < size:
        grown = size - confusion.shape[1]
        confusion = np.pad(confusion, ((0, 0), (0, grown), (0, grown)))
    errors = area_errors(pixels, confusion, scene.scale_error)
    seen = max(int(pixels.sum()), 1)
    rows = []
    for label, name in names.items():
        mine = np.array([patch.pixels * square for patch in patches if patch.label == label])
        factor = surfaces[label] / pixels[label] if pixels[label] else 1.0
        rows.append(
            {
                "label": label,
                "name": name,
                "pixels": int(pixels[label]),
                "planar_area": pixels[label] * square,
                "planar_corrected": errors.corrected[label] * square,
                "planar_low": errors.low[label] * square,
                "planar_high": errors.high[label] * square,
                "surface_area": surfaces[label] * square,
                "surface_low": factor * errors.low[label] * square,
                "surface_high": factor * errors.high[label] * square,
                "cover_percent": 100 * pixels[label] / seen,
                "cover_low": 100 * errors.cover_low[label],
                "cover_high": 100 * errors.cover_high[label],
                "patches": len(mine),
                "patch_mean": float(mine.mean()) if len(mine) else 0.0,
            }
            | {key: float(np.quantile(mine, q)) if len(mine) else 0.0 for key, q in QUANTILES.items()}
        )
    return [{key: float(v) if isinstance(v, np.floating) else v for key, v in row.items()} for row in rows]


def _surfaces(labels: Path, heights: Path, grid: MapGrid, step: int) -> np.ndarray:
    """Sum surface over planar area of the pixels of each label, (255,); 1 where the surface is not known."""
    sums, margin = np.zeros(NO_LABEL), surface_margin(step)
    inner = (slice(margin, -margin),) * 2
    for tile in tiles_of(grid):
        around = read_map(labels, tile, margin=margin).values
        factor = surface_factor(read_heights(heights, tile=tile, margin=margin), grid.pixel, step, around)[inner]
        part = around[inner]
        seen = part != NO_LABEL
        sums += np.bincount(part[seen], np.where(np.isfinite(factor), factor, 1.0)[seen], NO_LABEL)
    return sums


def _error_notes(confusion: np.ndarray, rows: list[dict[str, Any]], scene: MapScene) -> list[str]:
    """Say what the intervals hold."""
    notes = []
    if len(confusion):
        notes.append(f"Intervals hold the confusion of labels in {len(confusion)} held-out images.")
        seen = np.flatnonzero(confusion.sum(axis=(0, 2)))
        unseen = [row["name"] for row in rows if row["pixels"] and row["label"] not in seen]
        if unseen:
            names = ", ".join(unseen)
            notes.append(f"No held-out image shows {names}: its interval does not hold wrong labels.")
    else:
        notes.append("Intervals do not hold wrong labels: there are no masks of held-out images to find them from.")
    if scene.scale_error is None:
        notes.append("Intervals do not hold the error of the scale, which is not known.")
    return notes


def _write_table(path: Path, rows: list[dict[str, Any]]) -> None:
    cells = ([f"{value:.6g}" if isinstance(value, float) else value for value in row.values()] for row in rows)
    write_csv(path, list(rows[0]) if rows else ["label"], cells)


def _update_counts(path: Path, labels: np.ndarray) -> None:
    """Count the splats of each label in labels.json anew; without the file nothing is done."""
    if not path.exists():
        return
    document = read_json(path, "")
    for entry in document["labels"]:
        entry["count"] = int((labels == entry["id"]).sum())
    write_json(path, document | {"unlabelled": int((labels == 0).sum())})
