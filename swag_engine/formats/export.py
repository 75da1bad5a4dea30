"""Export of the result of a run to files that other programs read."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import InputError, continue_run, remedy
from ..scene.cameras import Camera
from ..scene.georeference import Georeference, Placement, read_georeference
from ..settings.field import check_settings, setting
from ..splats.develop_splats import bake_development, name_development
from ..splats.development import NO_DEVELOPMENT
from ..splats.haze import haze_amount, with_haze
from ..splats.splats import Splats
from ..splats.transform import rotation_to_y_up, transformed
from .cameras import PosedImage, transform_camera, write_cameras
from .ply import read_ply
from .registry import FORMATS, FormatName
from .run_folder import RunFolder, write_json
from .select import SplatSelection, box_between, label_ids, require_splats
from .water import bake_water, transform_water

if TYPE_CHECKING:
    from ..scene.colmap import Scene

AXES = {
    "scene": "Those of the scene",
    "y-down": "Turned so that -y is up, as viewers of PLY files expect",
    "y-up": "Turned so that y is up",
    "z-up": "Turned so that z is up, as in Blender",
}
"""Axes of an exported file, with a description of each."""
FROM_Y_UP = {
    "y-up": np.eye(3),
    "y-down": np.diag([1.0, -1, -1]),
    "z-up": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
}
"""Rotations (3, 3) from axes with y up."""


@dataclass(frozen=True)
class ExportOptions:
    """What a user chooses about an exported file.

    Raises:
        InputError: If a value is outside its range.
    """

    water: float = setting(
        0.0,
        "Water",
        "How much water the colors show, from 0 (removed) to 1 (as photographed); with water they are right only from "
        "where the photos were taken, and open water behind the splats is missing",
        least=0,
        most=1,
    )
    haze: float = setting(
        0.0,
        "Haze",
        "How much of the haze in open water is written, from 0 (none) to 1 (as trained); at least as much as of the "
        "water",
        least=0,
        most=1,
    )
    develop: str = setting(
        "auto",
        "Development",
        "How restored colors are developed: auto (exposure and white point that the run found; less of it the more "
        "water is shown), chart (from a color chart in the photos), none, or values as in "
        "exposure=0.5,white=1.1/1/0.9,contrast=1.1; highlights are not rolled off",
    )
    labels: tuple[str, ...] = setting(
        (), "Labels", "Only splats with these labels, by name or number; all splats where none is given"
    )
    box: tuple[float, float, float, float, float, float] | None = setting(
        None, "Box", "Only splats in the box between two corners x y z x y z, in coordinates of the scene"
    )
    min_opacity: float = setting(0.0, "Minimum Opacity", "Only splats of at least this opacity", least=0, most=1)
    sh_degree: int = setting(
        3,
        "SH Degree",
        "Highest degree of spherical harmonics; 0 makes colors the same from every view, and the smallest file",
        least=0,
        most=3,
    )
    extras: bool = setting(True, "Extra Properties", "Write labels and other properties of the splats, too")
    up: str = setting("scene", "Axes", "Axes of a PLY; a GLB and an SPZ always have y up", choices=AXES)
    metres_per_unit: float = setting(
        0.0,
        "Metres per Unit",
        "Length in metres of one unit of the scene's coordinates; the file is then in metres",
        least=1e-9,
        most=1e9,
        unit="m",
        zero="that of the scene's scale.json, or else the length that the run was given; without both, the scene's "
        "units are kept",
    )
    georeferenced: bool = setting(
        False,
        "Georeferenced",
        "Write the metric frame that the command scale measured: x east, y north, z up in metres, with the offset and "
        "the coordinate reference system in the file",
    )
    cameras: bool = setting(
        False,
        "Cameras",
        "Write the cameras, too: into a GLB, and to the folder NAME_cameras beside the file as a COLMAP text model, "
        "transforms.json and, where the run models water, water.json",
    )
    forecast: bool = setting(False, "Forecast", "Write nothing, and only report how large the file would be")

    def __post_init__(self) -> None:
        check_settings(self)
        if self.georeferenced and (self.up not in ("scene", "z-up") or self.metres_per_unit):
            raise InputError("A georeferenced file is in metres with z up: leave Axes and Metres per Unit as they are.")


def export_run(folder: Path, format: FormatName, out: Path, options: ExportOptions | None = None) -> dict[str, Any]:
    """Write the result of a run to a file.

    Args:
        folder: Folder of the run.
        format: Name of a format in formats/registry.py.
        out: File to write.
        options: What the file holds; the defaults without.

    Returns:
        `out`; `splats`, their number; `bytes`, the size of the file; `files`, all that were written; `development`,
        what was done to the colors (as `Development.to_json`); `notes`, sentences for the user.

    Raises:
        InputError: If the folder is not a run or has no result yet, no splats are left to write, or `out` cannot be
            written.
    """
    options = options or ExportOptions()
    target = FORMATS[format]
    run = RunFolder(folder)
    scene_folder, settings, up = run.read_config()
    if not run.ply.exists():
        raise InputError(f"The run {folder} has no result yet; {continue_run()}.")
    scene = None
    if options.cameras or options.water:
        from ..scene.colmap import load_scene

        scene = load_scene(scene_folder)
    run.refuse_own(out)
    stored = read_ply(run.ply)
    box = None
    if options.box:
        corners = np.reshape(options.box, (2, 3))
        middle, origin = corners.mean(axis=0), np.array(stored.origin)
        # In coordinates of the COLMAP model, or of the run, which are relative to its origin: the nearer ones count.
        corners = corners - origin if np.linalg.norm(middle - origin) < np.linalg.norm(middle) else corners
        box = box_between(*corners.tolist())
    selection = SplatSelection(
        labels=label_ids(options.labels, folder / "labels.json") if options.labels else None,
        box=box,
        min_opacity=options.min_opacity,
        sh_degree=options.sh_degree,
        extras=options.extras,
    )
    shown = with_haze(stored, haze_amount(options.water, options.haze))
    splats = require_splats(selection.apply(shown))
    medium = run.read_water()
    development = run.color_view(options.develop).at(options.water)
    unapplied = run.color_view("auto").at(options.water) if options.develop == "none" else NO_DEVELOPMENT
    if options.water and scene:
        splats = with_water(splats, medium, [v.camera for v in scene.views], options.water, settings.metres_per_unit)
    splats = bake_development(name_development(splats, unapplied), development)
    measured = read_georeference(scene_folder, splats.origin)
    metres = options.metres_per_unit or (measured.metres_per_unit if measured else settings.metres_per_unit)
    fixed_axes = "up" not in target.options
    # A format with fixed axes rotates the splats itself, from `up`.
    matrix = np.diag([metres or 1.0] * 3 + [1.0])
    turn = np.eye(4)
    placement = None
    if options.georeferenced:
        matrix, placement = georeferenced_frame(measured, scene_folder)
        up, metres = [0.0, 0.0, 1.0], measured.metres_per_unit if measured else 1.0
    if fixed_axes:
        turn[:3, :3] = rotation_to_y_up(up)
    elif options.up != "scene" and not options.georeferenced:
        matrix[:3, :3] = FROM_Y_UP[options.up] @ rotation_to_y_up(up) @ matrix[:3, :3]
    into_file = turn @ matrix
    rotation = into_file[:3, :3] / (metres or 1.0)
    if not np.array_equal(matrix, np.eye(4)):  # so that splats without a change stay the same to the bit
        splats = transformed(splats, matrix)
    splats = replace(splats, placement=placement, origin=(0.0, 0.0, 0.0) if placement else splats.origin)
    cameras = [transform_camera(view.camera, matrix) for view in scene.views] if scene and options.cameras else []
    result: dict[str, Any] = {"out": str(out), "splats": len(splats), "files": [], "notes": []}
    result["development"] = development.to_json()
    result["bytes"] = target.size(out, splats, up, cameras)
    if options.forecast:
        return result
    target.write(out, splats, up, cameras)
    result["notes"] = target.notes(splats)
    if splats.development and splats.development.applied:
        done = replace(development, knee=1.0).to_text()
        how = remedy("--develop none", "Development: None in the panel Color")
        result["notes"].append(f"Colors are developed ({done}); {how} leaves them restored.")
    files = [out]
    if options.cameras and scene:
        beside = cameras_folder(out)
        points = scene.points.positions @ into_file[:3, :3].T + into_file[:3, 3]
        images = _posed_images(scene, into_file, beside)
        written, notes = write_cameras(beside, images, points, scene.points.colors)
        result["notes"] += notes
        files += written
        if placement:
            write_json(beside / "georeference.json", placement.file_json(turn[:3, :3]))
            files.append(beside / "georeference.json")
        if medium:
            in_file = transform_water(medium, rotation, metres or 1.0, settings.metres_per_unit, bool(metres))
            write_json(beside / "water.json", in_file)
            files.append(beside / "water.json")
    result["files"] = [str(path) for path in files]
    return result


def georeferenced_frame(measured: Georeference | None, scene_folder: Path) -> tuple[np.ndarray, Placement]:
    """Return the matrix (4, 4) from a scene to its metric frame, and where that lies.

    Raises:
        InputError: If the scene was not measured.
    """
    if not measured:
        raise InputError(
            f"The scale of {scene_folder} was not measured: measure it with the command scale and import the scene "
            "again, or export without Georeferenced."
        )
    return measured.matrix, measured.placement or Placement(None, (0.0, 0.0, 0.0))


def with_water(
    splats: Splats, medium: dict[str, Any] | None, cameras: Sequence[Camera], amount: float, metres_per_unit: float
) -> Splats:
    """Add water to the colors of splats.

    Args:
        splats: Splats without water.
        medium: Contents of the run's water.json, None where it models no water.
        cameras: Cameras of the splats' world, at least one.
        amount: How much of the water, 0..1.
        metres_per_unit: Length of one scene unit in metres, 0 where it is not known.

    Returns:
        The splats; unchanged where the run models no water and all of it is asked for, because the colors hold it.

    Raises:
        InputError: If the run models no water and a part of it is asked for, or water.json is damaged.
    """
    if medium:
        return bake_water(splats, medium, cameras, amount, metres_per_unit)
    if amount == 1:
        return splats
    raise InputError("The run modelled no water, so its colors hold all of it: export it with water 1 or 0.")


def cameras_folder(out: Path) -> Path:
    """Return the folder for the cameras of an exported file."""
    return out.with_name(f"{out.stem}_cameras")


def describe(result: dict[str, Any]) -> str:
    """Return the lines that the command `export` prints.

    Args:
        result: What `export_run` returned.
    """
    size = f"{result['splats']} splats, {result['bytes'] / 1e6:.1f} MB"
    if not result["files"]:
        return f"{result['out']} would have {size}."
    return "\n".join([f"{result['files'][0]}: {size}", *result["files"][1:], *result["notes"]])


def _posed_images(scene: "Scene", matrix: np.ndarray, folder: Path) -> list[PosedImage]:
    """Describe the scene's image files, with paths relative to a folder and poses transformed by a matrix (4, 4)."""

    def relative(path: Path) -> str:
        try:
            return Path(os.path.relpath(path, folder)).as_posix()
        except ValueError:  # on another drive of Windows
            return path.as_posix()

    return [
        PosedImage(
            transform_camera(view.camera, matrix), view.lens.model, view.lens.width, view.lens.height, view.lens.params,
            relative(view.path),
        )
        for view in scene.views
    ]  # fmt: skip
