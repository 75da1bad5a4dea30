"""Change between two surveys of one place: aligned, mapped, listed, and shown on a page."""

import base64
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import DTypeLike

from ..base.errors import InputError, remedy
from ..base.files import not_writable, write_csv
from ..base.html_page import paragraph_html, table_html, write_page
from ..formats.run_folder import write_json
from ..formats.select import LABEL
from ..splats.transform import transformed
from .alignment import Alignment, align
from .change_maps import FLAGS, SAMPLE, Comparison, Survey
from .geotiff import NO_HEIGHT, NO_LABEL, Color, create_map, map_crs, map_transform
from .grid import MapGrid
from .heights import EDGE, tile_heights
from .label_map import label_name, splat_labels, tile_labels
from .map_frame import MapScene, load_map_scene
from .ortho import map_answer
from .packages import require_packages
from .photo_check import SurveyPhotos
from .preview import write_preview
from .tiles import Progress, TileRenderer, tiles_of
from .views import height_errors

ScaleChoice = Literal["fixed", "free"]
GPS_ERROR = 100.0
"""Distance between the coordinates of two surveys of one place that is put down to GPS, metres."""
PREVIEW = 1600
"""Largest edge of an image on the page, pixels."""
FLAG_COLORS: dict[int, Color] = {
    0: (230, 230, 230),
    1: (33, 102, 172),
    2: (178, 24, 43),
    3: (244, 165, 30),
    4: (118, 42, 131),
}
FILES = {
    "maps": "change.tif",
    "flags": "changed.tif",
    "objects": "changes.csv",
    "labels": "label_change.csv",
    "page": "change.html",
    "answer": "change.json",
}
"""Files in the folder of a change."""


def make_change(
    earlier: Path,
    later: Path,
    out: Path,
    pixel: float = 0.0,
    box: tuple[float, float, float, float] | None = None,
    plane: str = "up",
    scale: ScaleChoice = "fixed",
    backend: str = "auto",
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Compare two runs of one place.

    Args:
        earlier: Folder of the earlier run, or a PLY file.
        later: Folder of the later run, or a PLY file.
        out: Folder of the files in FILES.
        pixel: Edge of a pixel; chosen from the splats where it is 0.
        box: Left, bottom, right and top edge in the map of the earlier run.
        plane: As in `load_map_scene`.
        scale: Whether the scale of the later survey is kept, or found by the alignment.
        backend: What renders.
        progress: As in `make_ortho`.

    Returns:
        As `make_ortho` for the earlier run, with `alignment` (matrix, scale, residual, static fraction),
        `height_noise` (the median of the smallest change that is told), `objects`, and `changed`, the fraction of the
        seen pixels that changed.

    Raises:
        InputError: If an option or a file cannot be used.
    """
    require_packages()
    first, second = load_map_scene(earlier, plane), load_map_scene(later, plane)
    unknown = [source.name for source, one in ((earlier, first), (later, second)) if one.unit != "m"]
    if unknown and scale == "fixed":
        raise InputError(
            f"The scale of {' and of '.join(unknown)} is not known: measure it with "
            + remedy(
                "the command scale, or let the alignment find the scale of the later run with --scale free.",
                "the panel Scale.",
            )
        )
    _check_one_place(earlier, first, later, second)
    if progress:
        progress("Aligning", 0.0)
    alignment = align(second.splats, first.splats, _initial(first, second), scale == "free")
    splats, matrix = transformed(second.splats, alignment.matrix), alignment.matrix @ second.matrix
    moved = replace(second, splats=splats, matrix=matrix)
    grid = first.grid(pixel, box)
    crs = map_crs(first)
    files = {name: out / file for name, file in FILES.items()}
    photos = SurveyPhotos.of(first), SurveyPhotos.of(moved)
    with _scratch_folder(out) as folder:
        before, after = (
            _survey(scene, seen_by, grid, backend, folder / which, f"Rendering the {which} run", progress)
            for scene, seen_by, which in zip((first, moved), photos, ("earlier", "later"), strict=True)
        )
        _same_labels(first, second, after)
        comparison = Comparison(before, after, grid, alignment.residual, photos)
        if not comparison.overlap:
            box_too = remedy(", or --box", "")
            raise InputError(f"The two surveys have no pixel in common: check that they show one place{box_too}.")
        flags = _scratch_array(folder / "flags", (grid.height, grid.width), np.uint8)
        found, limit = _write_maps(files["maps"], first, comparison, flags, folder, progress)
        _write_flags(files["flags"], first, grid, flags)
        objects = _placed(found, first, grid)
        _write_objects(files["objects"], objects, first)
        _write_transitions(files["labels"], comparison.label_transitions(), first)
        counts = np.zeros(256, np.int64)
        for tile in tiles_of(grid):
            counts += np.bincount(flags[tile.place].ravel(), minlength=256)
        seen = int(counts[:NO_LABEL].sum())
        preview = write_preview(files["flags"], first, grid)
        answer = map_answer(out, [*files.values(), preview], preview, grid, first, crs) | {
            "covered": seen / flags.size,
            "alignment": {
                "matrix": alignment.matrix.tolist(),
                "scale": alignment.scale,
                "residual": alignment.residual,
                "static": alignment.static,
                "points": alignment.points,
            },
            "height_noise": limit,
            "changed": int(counts[1:NO_LABEL].sum()) / max(seen, 1),
            "objects": objects,
            "notes": [*first.notes, *_notes(alignment, comparison)],
        }
        _write_page(files["page"], answer, before, after, flags)
    write_json(files["answer"], answer)
    return answer


def describe(document: dict[str, Any]) -> str:
    """Return the lines that the command `change` prints.

    Args:
        document: What `make_change` returned.
    """
    unit, found = document["unit"], document["alignment"]
    lines = [
        f"Aligned with {found['residual']:.3g} {unit} between static surfaces ({found['static']:.0%} of the splats), "
        f"scale {found['scale']:.5g}. Changes of height above {document['height_noise']:.3g} {unit} are told at 95 %."
    ]
    for item in document["objects"]:
        lines.append(
            f"{item['change']:<8} at {item['x']:.10g} {item['y']:.10g}: {item['area']:.4g} {unit}², height "
            f"{item['height_change']:+.3g} {unit}, volume {item['volume_change']:+.3g} {unit}³"
        )
    if not document["objects"]:
        lines.append("No change can be told.")
    return "\n".join([*lines, *document["files"], *document["notes"]])


def _check_one_place(earlier: Path, first: MapScene, later: Path, second: MapScene) -> None:
    """Refuse surveys whose coordinates are farther apart than their sizes and errors of GPS."""
    from rasterio.warp import transform

    if not (first.placement and first.placement.crs and second.placement and second.placement.crs):
        return
    texts, places, reach = [], [], GPS_ERROR
    for source, scene, placement in ((earlier, first, first.placement), (later, second, second.placement)):
        across = scene.splats.positions[:, :2]
        place = np.median(across, axis=0) + placement.offset[:2]
        reach += float(np.linalg.norm(np.ptp(np.percentile(across, (2, 98), axis=0), axis=0)))
        texts.append(f"{source} lies at {place[0]:.0f} {place[1]:.0f} in {placement.crs}")
        (x,), (y,) = transform(map_crs(scene), map_crs(first), place[:1], place[1:])
        places.append((x, y))
    apart = float(np.linalg.norm(np.subtract(places[0], places[1])))
    if not apart <= reach:
        raise InputError(
            f"The coordinates contradict each other: {' and '.join(texts)}, {apart / 1000:.1f} km apart. Compare "
            "surveys of one place, or measure the scale of the wrong one again with its coordinate reference system."
        )


def _initial(first: MapScene, second: MapScene) -> np.ndarray | None:
    """Where the frames lie in one coordinate reference system, the transform from the second to the first."""
    a, b = first.placement, second.placement
    if a is None or b is None or a.crs != b.crs or not (first.north and second.north):
        return None
    matrix = np.eye(4)
    matrix[:3, 3] = np.array(b.offset) - np.array(a.offset)
    return matrix


@contextmanager
def _scratch_folder(out: Path) -> Iterator[Path]:
    """Yield a folder beside the results for arrays of the size of the maps, which is removed at the end."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        folder = TemporaryDirectory(prefix=".scratch-", dir=out, ignore_cleanup_errors=True)
    except OSError as error:
        raise not_writable(out, error) from error
    with folder as path:
        yield Path(path)


def _scratch_array(path: Path, shape: tuple[int, ...], dtype: DTypeLike) -> np.ndarray:
    """Make an array of zeros in a file, which is mapped to memory."""
    try:
        return np.memmap(path, dtype, "w+", shape=shape)
    except OSError as error:
        raise not_writable(path, error) from error


def _survey(
    scene: MapScene,
    photos: SurveyPhotos | None,
    grid: MapGrid,
    backend: str,
    path: Path,
    stage: str,
    progress: Progress | None,
) -> Survey:
    """Render the arrays of a `Survey` to files whose names begin with `path`.

    Errors grow with transparency: splats that are seen through are spread in depth.
    """
    renderer = TileRenderer(scene.splats, grid, backend, scene.seen)
    colors, cameras = renderer.colors(), photos.cameras if photos else []
    has_labels = LABEL in scene.splats.extras and scene.splats.extras[LABEL].any()
    labels = splat_labels(scene.splats) if has_labels else None
    shape = grid.height, grid.width
    image = _scratch_array(path.with_suffix(".colors"), (*shape, 3), np.uint8)
    heights = _scratch_array(path.with_suffix(".heights"), shape, np.float32)
    layers = _scratch_array(path.with_suffix(".layers"), shape, np.float32)
    found = None if labels is None else _scratch_array(path.with_suffix(".labels"), shape, np.uint8)
    errors = _scratch_array(path.with_suffix(".errors"), shape, np.float32)
    for tile in tiles_of(grid, EDGE, stage, progress):
        chosen = renderer.inside(tile)
        values, alpha = renderer.render(tile, chosen, colors[chosen])
        shown = scene.development.apply(values / np.maximum(alpha, 1e-6)[..., None])
        image[tile.place] = np.round(255 * np.clip(shown, 0, 1))
        found_heights = tile_heights(renderer, tile)
        surface = found_heights.first
        heights[tile.place], layers[tile.place] = surface, np.abs(surface - found_heights.median)
        by_rays = height_errors(cameras, scene, grid, tile, surface) if cameras else np.ones(alpha.shape)
        errors[tile.place] = by_rays / np.maximum(alpha, 1e-6)
        if found is not None and labels is not None:
            found[tile.place] = tile_labels(renderer, tile, labels, scene.gains)
    return Survey(image, heights, errors, layers, found)


def _same_labels(first: MapScene, second: MapScene, after: Survey) -> None:
    """Give the labels of the later survey the numbers that their names have in the earlier one, new ones 0."""
    if after.labels is None or not (first.labels and second.labels):
        return
    numbers = {name: number for number, name in first.labels.items()}
    table = np.zeros(256, np.uint8)
    table[NO_LABEL] = NO_LABEL
    for number, name in second.labels.items():
        table[number] = numbers.get(name, 0)
    for row in range(0, len(after.labels), EDGE):
        after.labels[row : row + EDGE] = table[after.labels[row : row + EDGE]]


def _placed(objects: list[dict[str, Any]], scene: MapScene, grid: MapGrid) -> list[dict[str, Any]]:
    """Add coordinates to objects, the largest first."""
    transform = map_transform(scene, grid)
    placed = []
    for item in sorted(objects, key=lambda item: -item["area"]):
        x = transform.c + transform.a * (item["column"] + 0.5)
        y = transform.f + transform.e * (item["row"] + 0.5)
        placed.append({"x": x, "y": y} | item)
    return placed


def _write_maps(
    path: Path,
    scene: MapScene,
    comparison: Comparison,
    flags: np.ndarray,
    folder: Path,
    progress: Progress | None,
) -> tuple[list[dict[str, Any]], float]:
    """Write the differences and find the changed objects.

    Args:
        path: The GeoTIFF.
        scene: The earlier survey.
        comparison: Of both.
        flags: (H, W) zeros, which values of FLAGS are written to.
        folder: For scratch arrays.
        progress: Called before each tile.

    Returns:
        The objects, and the median of the smallest change of height that is told.
    """
    grid = comparison.grid
    told = _scratch_array(folder / "told", flags.shape, np.uint8)
    step = max(1, int(np.ceil(np.sqrt(flags.size / SAMPLE))))
    limits = []
    names = "height change", "smallest change told at 95 %", "color change"
    with create_map(path, scene, grid, names, "float32", NO_HEIGHT) as writer:
        for tile in tiles_of(grid, stage="Comparing", progress=progress):
            found = comparison.differences(tile)
            known = np.isfinite(found.height)
            bands = np.stack([found.height, np.where(known, found.limit, np.nan), found.color], axis=2)
            writer.write(tile, np.where(np.isfinite(bands), bands, NO_HEIGHT))
            told[tile.place] = comparison.told(tile, found)
            flags[tile.place] = np.where(known, 0, NO_LABEL)
            limits.append(found.limit[known][:: step**2])
    numbers = _scratch_array(folder / "numbers", flags.shape, np.int32)
    return comparison.find_objects(told, flags, numbers), float(np.median(np.concatenate(limits)))


def _write_flags(path: Path, scene: MapScene, grid: MapGrid, flags: np.ndarray) -> None:
    """Write the map of changes."""
    tags = {f"VALUE_{value}": name for value, name in FLAGS.items()}
    with create_map(path, scene, grid, ("change",), "uint8", NO_LABEL, FLAG_COLORS, tags) as writer:
        for tile in tiles_of(grid):
            writer.write(tile, flags[tile.place][..., None])


def _write_objects(path: Path, objects: list[dict[str, Any]], scene: MapScene) -> None:
    columns = [
        "change", "x", "y", "pixels", "area", "height_change", "height_limit", "volume_change", "color_change",
        "label_before", "label_after",
    ]  # fmt: skip
    rows = []
    for item in objects:
        row = {key: f"{item[key]:.8g}" if isinstance(item[key], float) else item[key] for key in columns}
        for key in ("label_before", "label_after"):
            row[key] = "" if item[key] is None else label_name(scene, item[key])
        rows.append(row)
    write_csv(path, columns, ([row[name] for name in columns] for row in rows))


def _write_transitions(path: Path, transitions: dict[tuple[int, int], float], scene: MapScene) -> None:
    rows = [(label_name(scene, a), label_name(scene, b), f"{area:.6g}") for (a, b), area in transitions.items()]
    write_csv(path, ["before", "after", "area"], rows)


def _notes(alignment: Alignment, comparison: Comparison) -> list[str]:
    notes, before, after = [], comparison.before, comparison.after
    if alignment.static < 0.5:
        notes.append(
            f"Only {alignment.static:.0%} of the splats agree with the alignment: the surveys may not show one place."
        )
    if before.labels is None or after.labels is None:
        notes.append("Labels are not compared: both runs need them.")
    if count := comparison.errors_found:
        notes.append(
            f"{count} {'difference' if count == 1 else 'differences'} of height are left out: the photos of one survey "
            "show the surface where the other survey has it."
        )
    return notes


def _write_page(path: Path, answer: dict[str, Any], before: Survey, after: Survey, flags: np.ndarray) -> None:
    """Write a page on which the later orthomosaic is wiped over the earlier one, with the map of changes below."""
    colored = np.full((256, 3), 255, np.uint8)
    for value, color in FLAG_COLORS.items():
        colored[value] = color
    step = max(1, int(np.ceil(max(flags.shape) / PREVIEW)))
    images = [_data_url(image[::step, ::step]) for image in (before.colors, after.colors)]
    images.append(_data_url(colored[flags[::step, ::step]]))
    unit = answer["unit"]
    rows = [
        [
            item["change"], f"{item['x']:.10g}", f"{item['y']:.10g}", f"{item['area']:.4g}",
            f"{item['height_change']:+.3g}", f"{item['volume_change']:+.3g}",
        ]
        for item in answer["objects"]
    ]  # fmt: skip
    heads = "change", "x", "y", f"area [{unit}²]", f"height [{unit}]", f"volume [{unit}³]"
    table = table_html(rows, heads, ["", *["number"] * 5])
    notes = "\n".join(paragraph_html(note, "note") for note in answer["notes"])
    legend = ", ".join(
        f'<span style="color: rgb{FLAG_COLORS[value]}">&#9632;</span> {name}' for value, name in FLAGS.items()
    )
    body = f"""{paragraph_html(describe(answer).splitlines()[0])}
<style>.wiped {{ width: 100%; position: absolute; left: 0; top: 0; clip-path: inset(0 50% 0 0); }}</style>
<p>Move the slider: left the earlier survey, right the later one.</p>
<div style="position: relative; max-width: 1000px">
<img src="{images[1]}" alt="later" style="width: 100%; display: block">
<img id="earlier" src="{images[0]}" alt="earlier" class="wiped">
</div>
<input id="wipe" type="range" min="0" max="100" value="50" style="width: 100%; max-width: 1000px" aria-label="Wipe">
<script>
const wipe = document.getElementById("wipe");
wipe.addEventListener("input", () => {{
  document.getElementById("earlier").style.clipPath = `inset(0 ${{100 - wipe.value}}% 0 0)`;
}});
</script>
<h2>Changes that can be told at 95 %</h2>
<p>{legend}</p>
<img src="{images[2]}" alt="map of changes" style="width: 100%; max-width: 1000px">
{table}
{notes}"""
    write_page(path, "Change between two surveys", [body])


def _data_url(image: np.ndarray) -> str:
    """A PNG of an image (H, W, 3) within a page."""
    data = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))[1].tobytes()
    return f"data:image/png;base64,{base64.b64encode(data).decode()}"
