"""Splat objects as files for other programs."""

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ..swag_engine.base.errors import InputError
from ..swag_engine.base.files import require_parent
from ..swag_engine.formats.cameras import PosedImage, transform_camera, write_cameras
from ..swag_engine.formats.export import ExportOptions, cameras_folder, georeferenced_frame, with_water
from ..swag_engine.formats.gltf import COLMAP_UP, Z_UP
from ..swag_engine.formats.registry import find_format
from ..swag_engine.formats.run_folder import read_json, write_json
from ..swag_engine.formats.select import SplatSelection, label_ids, require_splats
from ..swag_engine.formats.water import transform_water
from ..swag_engine.scene.cameras import Camera
from ..swag_engine.scene.georeference import Placement
from ..swag_engine.settings.field import settings_of
from ..swag_engine.splats.develop_splats import bake_development, name_development
from ..swag_engine.splats.haze import with_haze
from ..swag_engine.splats.splats import Splats, concatenate
from ..swag_engine.splats.transform import rotation_to_y_up, transformed
from . import colors, scene_import, splats
from .blender_types import present
from .cameras import cameras_of
from .georeference import georeference_of, placement_of
from .labels import labels_of
from .runs import RUN_KEY, water_run
from .setting_property import setting_property, texts_of
from .splat_parts import part_of
from .water import shown_haze

FRAMES = {
    "UPRIGHT": splats.FILE_FRAME,
    "Y_UP": Matrix.Rotation(np.radians(90), 4, "X"),
    "Z_UP": Matrix.Identity(4),
}
"""Axes that the user chooses for a file: the matrix from file to Blender world."""
NOTHING = {
    "ALL": "The objects have no splats: choose others.",
    "VISIBLE": "No splats are visible: show their labels, move the crop box, or choose All.",
    "SELECTED": "No splats are selected: select splats first, or choose Visible or All.",
}
"""Which splats of an object are written, and what is said where these are none."""
OPTIONS = ("water", "labels", "min_opacity", "sh_degree", "extras", "cameras")
"""Options of the engine that the dialog offers. In place of the others it has the scene's colors, an object to crop by,
axes named after Blender's, the length of a Blender unit, and the size of the file."""
OPTION_PROPERTIES = {
    name: setting_property(default, described)
    for name, default, described in settings_of(ExportOptions)
    if name in OPTIONS
}
"""Blender's properties of these options."""


@dataclass(frozen=True)
class ExportSettings:
    """What the export dialog asks.

    Attributes:
        use: "SELECTED" or "VISIBLE" splat objects.
        part: which of their splats, a key of NOTHING.
        frame: a key of FRAMES, "SCENE" for the COLMAP frame, or "GEOREFERENCED" for the metric one that was measured; a
            format with fixed axes has "UPRIGHT", "SCENE" or "GEOREFERENCED".
        metres_per_unit: length of a Blender unit in metres; the file is in metres. A georeferenced file is in any case.
        crop_object: name of the object whose bounding box crops the splats; "" for none.
        develop: whether colors are developed as the panel Color says.
        options: the options of OPTIONS; the others are not used.
    """

    use: str = "SELECTED"
    part: str = "VISIBLE"
    frame: str = "UPRIGHT"
    metres_per_unit: float = 1.0
    crop_object: str = ""
    develop: bool = True
    options: ExportOptions = field(default_factory=ExportOptions)

    @classmethod
    def from_dialog(cls, dialog: Any) -> "ExportSettings":
        """Take the settings from an operator that has them as properties."""
        own = {each.name: getattr(dialog, each.name) for each in fields(cls) if each.name != "options"}
        values = {name: getattr(dialog, name) for name in OPTIONS}
        return cls(**own, options=ExportOptions(**values | {"labels": texts_of(values["labels"])}))


def save_splats(context: bpy.types.Context, path: Path, settings: ExportSettings) -> tuple[int, list[str]]:
    """Write splat objects as one file, and their cameras beside it where `settings` ask for them.

    Returns:
        The number of splats, and sentences about what a format cannot hold.

    Raises:
        InputError: nothing to save, wrong settings, or a file that cannot be written.
    """
    format = find_format(require_parent(path))
    objects = _chosen_objects(context, settings)
    to_file, up, lies_at = _file_frame(objects, path, settings)
    parts = []
    for obj, placement, part in _selected_splats(context, objects, settings):
        if settings.options.water and len(part):
            part = _add_water(context, obj, part, settings.options.water)
        development = colors.color_view(present(context.scene), obj).at(settings.options.water)
        part = (bake_development if settings.develop else name_development)(part, development)
        parts.append(transformed(part, to_file @ placement))
    joined = _join(parts, objects[0], to_file, lies_at)
    cameras = []
    if settings.options.cameras:
        cameras = [transform_camera(camera, to_file) for camera in cameras_of(context, _roots(objects))]
        if not cameras:
            raise InputError("There are no cameras to save: import the scene, add a camera, or turn Cameras off.")
    format.write(path, joined, up, cameras)
    notes = format.notes(joined)
    for obj in objects:
        if shifted := splats.count_only_shifted(obj):
            notes.append(
                f"Modifiers move {shifted} splats of {obj.name} so that their sizes and rotations cannot follow."
            )
    if joined.development is None and any(part.development for part in parts):
        notes.append("The objects have different developments, so the file does not name one: export them one by one.")
    if not cameras:
        return len(joined), notes
    turn = np.eye(4)
    if "up" not in format.options:
        turn[:3, :3] = rotation_to_y_up(up)
    folder = cameras_folder(path)
    notes += _save_cameras(folder, [transform_camera(camera, turn) for camera in cameras])
    in_metres = settings.metres_per_unit != 1.0 or lies_at is not None
    _save_water(objects[0], turn @ to_file, folder / "water.json", in_metres)
    if lies_at:
        write_json(folder / "georeference.json", lies_at.file_json(turn[:3, :3]))
    return len(joined), notes


def expected_size(context: bpy.types.Context, path: Path, settings: ExportSettings) -> str:
    """Number of splats and size of the file that save_splats would write, or why it would refuse, in words."""
    try:
        objects = _chosen_objects(context, settings)
        to_file, up, lies_at = _file_frame(objects, path, settings)
        # Frame and water change values, not their number: the size is found without them, which is quick.
        parts = [part for _, _, part in _selected_splats(context, objects, settings)]
        joined = _join(parts, objects[0], to_file, lies_at)
        size = find_format(require_parent(path)).size(path, joined, up, ())
    except InputError as error:
        return str(error)
    return f"{len(joined)} splats, {size / 1e6:.1f} MB"


def _join(parts: list[Splats], first: bpy.types.Object, to_file: np.ndarray, lies_at: Placement | None) -> Splats:
    """Join the splats of objects, which stay where they are to each other; the origin is that of the first object.

    Raises:
        InputError: there are none.
    """
    joined = replace(require_splats(concatenate(parts)), placement=lies_at)
    if not lies_at:
        linear = (to_file @ np.array(first.matrix_world, np.float64))[:3, :3]
        # Blender's matrices are float32: what is off by that alone is a turn by quarters, which is exact.
        quarters = np.round(linear)
        linear = quarters if np.allclose(linear, quarters, rtol=0, atol=1e-6) else linear
        x, y, z = (linear @ first.get(splats.ORIGIN_KEY, (0.0, 0.0, 0.0))).tolist()
        joined.origin = x, y, z
    return joined


def _chosen_objects(context: bpy.types.Context, settings: ExportSettings) -> list[bpy.types.Object]:
    visible = settings.use == "VISIBLE"
    candidates = context.visible_objects if visible else context.selected_objects
    chosen = [obj for obj in candidates if splats.is_splats(obj)]
    if not chosen:
        raise InputError(
            "No splats are visible: show the splat objects to save."
            if visible
            else "No splats are selected: select the splat objects to save."
        )
    return chosen


def _file_frame(
    objects: list[bpy.types.Object], path: Path, settings: ExportSettings
) -> tuple[np.ndarray, np.ndarray, Placement | None]:
    """The matrix (4, 4) from Blender's world to the file, the up vector (3,) of the splats, and where the file lies."""
    up = np.array(COLMAP_UP)
    if settings.frame == "GEOREFERENCED":
        root = scene_import.find_root(objects[0])
        if root is None and (own := placement_of(objects[0])):  # opened from a georeferenced file
            return np.linalg.inv(np.array(objects[0].matrix_world, np.float64)), np.array(Z_UP), own
        matrix, placement = georeferenced_frame(georeference_of(root), Path(root.name if root else objects[0].name))
        return matrix @ np.linalg.inv(np.array(present(root).matrix_world, np.float64)), np.array(Z_UP), placement
    if settings.frame == "SCENE":
        root = scene_import.find_root(objects[0])
        if root is None:
            raise InputError(f"{objects[0].name} belongs to no imported scene: choose the axes Upright.")
        frame, up = root.matrix_world, scene_import.up_of(root)
    else:
        frame = FRAMES[settings.frame if "up" in find_format(path).options else "UPRIGHT"]
    return np.diag([settings.metres_per_unit] * 3 + [1.0]) @ np.linalg.inv(np.array(frame, np.float64)), up, None


def _selected_splats(
    context: bpy.types.Context, objects: list[bpy.types.Object], settings: ExportSettings
) -> Iterator[tuple[bpy.types.Object, np.ndarray, Splats]]:
    """Each object with its matrix (4, 4) to Blender's world and, in its own frame, the splats to write of it.

    Raises:
        InputError: no object has splats of the asked part, or labels or the crop object are not there.
    """
    depsgraph = context.evaluated_depsgraph_get()
    options = settings.options
    found = False
    for obj in objects:
        # The evaluated matrix has parents, constraints and animation in it.
        placement = np.array(obj.evaluated_get(depsgraph).matrix_world, np.float64)
        names = Path(labels_of(obj).folder or bpy.path.abspath(obj.get(RUN_KEY, ""))) / "labels.json"
        labels = label_ids(options.labels, names) if options.labels else None
        box = _bounding_box(context, settings.crop_object) @ placement if settings.crop_object else None
        selection = SplatSelection(labels, box, options.min_opacity, options.sh_degree, options.extras)
        part = part_of(obj, placement, settings.part)
        part = with_haze(part, shown_haze(present(context.scene), options.water))
        found |= bool(len(part))
        yield obj, placement, selection.apply(part)
    if not found:
        raise InputError(NOTHING[settings.part])


def _add_water(context: bpy.types.Context, obj: bpy.types.Object, dry: Splats, amount: float) -> Splats:
    """The splats of an object with that fraction of its run's water in their colors."""
    roots = _roots([obj])
    if not roots:
        raise InputError(f"{obj.name} belongs to no imported scene, so its water is not known.")
    from_root = np.linalg.inv(np.array(roots[0].matrix_world, np.float64))
    cameras = [transform_camera(camera, from_root) for camera in cameras_of(context, roots)]
    if not cameras:
        raise InputError(f"The scene of {obj.name} has no cameras left, so its water cannot be shown.")
    medium, metres_per_unit = _water_of_run(obj)
    return with_water(dry, medium, cameras, amount, metres_per_unit)


def _save_cameras(folder: Path, cameras: list[Camera]) -> list[str]:
    """Write cameras without sparse points to `folder`; returns sentences about what a format cannot hold."""
    images = [PosedImage.from_camera(camera) for camera in cameras]
    return write_cameras(folder, images, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))[1]


def _save_water(obj: bpy.types.Object, to_file: np.ndarray, path: Path, in_metres: bool) -> None:
    """Write the coefficients of the object's water, where it has one, in the file's axes and scale."""
    medium, metres = _water_of_run(obj)
    if medium:
        training_to_file = (to_file @ np.array(obj.matrix_world, np.float64))[:3, :3]
        scale = float(np.cbrt(np.linalg.det(training_to_file)))
        per_metre = bool(metres) or in_metres
        write_json(path, transform_water(medium, training_to_file / scale, scale, metres, per_metre))


def _roots(objects: list[bpy.types.Object]) -> list[bpy.types.Object]:
    """The roots of the imported scenes that the objects belong to, each once."""
    return list(dict.fromkeys(root for obj in objects if (root := scene_import.find_root(obj))))


def _water_of_run(obj: bpy.types.Object) -> tuple[dict[str, Any] | None, float]:
    """The water of the run or survey that the object is from, None where there is none, and its metres per unit."""
    run = water_run(obj)
    if run is None or not run.water.exists():
        return None, 0.0
    return read_json(run.water, ""), run.read_config()[1].metres_per_unit


def _bounding_box(context: bpy.types.Context, name: str) -> np.ndarray:
    """Matrix (4, 4) from Blender's world to a space in which the object's bounding box reaches from -1 to 1."""
    obj = present(context.scene).objects.get(name)
    if obj is None:
        raise InputError(f"There is no object {name} to crop by: choose another or none.")
    corners = np.array(obj.bound_box)
    if obj.type == "EMPTY":
        corners = np.array([[-1.0] * 3, [1.0] * 3]) * obj.empty_display_size
    lower, upper = corners.min(axis=0), corners.max(axis=0)
    matrix = _to_unit_box(obj, (lower + upper) / 2, (upper - lower) / 2)
    if matrix is None:
        raise InputError(f"{name} has a scale of 0, so that no splats are inside: scale it, or choose another object.")
    return matrix


def _to_unit_box(obj: bpy.types.Object, centre: np.ndarray, half: np.ndarray) -> np.ndarray | None:
    """Matrix (4, 4) from Blender's world to a space in which a box in the object's frame reaches from -1 to 1.

    None where the object is scaled to 0.
    """
    # A flat object has no extent along an axis; the matrix must be invertible.
    box = np.diag([*np.maximum(half, 1e-9), 1.0])
    box[:3, 3] = centre
    placement = np.array(obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).matrix_world, np.float64)
    if not np.linalg.det(placement):
        return None
    return np.linalg.inv(placement @ box)
