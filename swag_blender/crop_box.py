"""The crop box of a splat object: another object whose box limits what is shown, selected, rendered and exported.

The box is the cube from -1 to 1 of that object's own space; for an empty, times its display size. Moving, rotating and
scaling the object changes the crop; the splats are never changed by it.
"""

from typing import Any, cast

import bpy
import numpy as np
from mathutils import Matrix

from ..swag_engine.base.errors import InputError
from . import splats
from .blender_types import present
from .nodes import splat_preview

PERCENTILES = (1.0, 99.0)
"""Range of coordinates, on each axis, that a new box encloses: single splats far away do not make it large."""
MARGIN = 1.05
"""Size of a new box, as a multiple of that range."""
MIN_THICKNESS = 0.01
"""Shortest edge of a new box, as a fraction of its longest, so that a flat scene has a box with a volume."""


def crop_of(obj: bpy.types.Object) -> bpy.types.Object | None:
    """The object that crops a splat object; None where there is none."""
    return cast(Any, obj).swag_display.crop


def can_crop(obj: bpy.types.Object, box: bpy.types.Object) -> bool:
    """Whether `box` can crop the splats of `obj`: an empty or a mesh, and not the parent of the splats."""
    return box != obj and box.type in {"EMPTY", "MESH"} and box != obj.parent


def half_edge(box: bpy.types.Object) -> float:
    """Half the edge of a crop box in its own space."""
    return box.empty_display_size if box.type == "EMPTY" else 1.0


def inside_crop(obj: bpy.types.Object) -> np.ndarray:
    """Mask (N,) bool of the splats whose centre is in the object's crop box; all splats without one.

    A box without volume, as after scaling it to zero, does not crop.
    """
    box = crop_of(obj)
    matrix = np.zeros((4, 4)) if box is None else np.array(box.matrix_world, np.float64)
    if box is None or np.linalg.det(matrix[:3, :3]) == 0:
        return np.ones(splats.count(obj), bool)
    to_box = np.linalg.inv(matrix) @ np.array(obj.matrix_world, np.float64)
    local = splats.positions(obj) @ to_box[:3, :3].T + to_box[:3, 3]
    return (np.abs(local) <= half_edge(box)).all(axis=1)


def add_crop_box(context: bpy.types.Context, objects: list[bpy.types.Object]) -> bpy.types.Object:
    """Make an empty cube around the splats of objects and crop them by it; returns the cube.

    It is fitted to the splats without the outermost on each axis of the first object's parent, or of the world.

    Raises:
        InputError: the objects hold no splats.
    """
    first = objects[0]
    frame = (first.parent.matrix_world if first.parent else Matrix.Identity(4)).normalized()
    points = []
    for obj in objects:
        to_frame = np.array(frame.inverted() @ obj.matrix_world, np.float64)
        points.append(splats.positions(obj) @ to_frame[:3, :3].T + to_frame[:3, 3])
    positions = np.concatenate(points)
    if not len(positions):
        raise InputError(f"{first.name} holds no splats: there is nothing to crop.")
    lower, upper = np.percentile(positions, PERCENTILES, axis=0)
    half = (upper - lower) / 2 * MARGIN
    half = np.maximum(half, max(half.max() * MIN_THICKNESS, 1e-6))
    box = bpy.data.objects.new(f"{first.name} Crop Box", None)
    box.empty_display_type, box.empty_display_size = "CUBE", 1.0
    collection = first.users_collection[0] if first.users_collection else present(context.scene).collection
    collection.objects.link(box)
    box.matrix_world = frame @ Matrix.Translation(((lower + upper) / 2).tolist()) @ Matrix.Diagonal((*half, 1.0))
    present(context.view_layer).update()
    for obj in objects:
        cast(Any, obj).swag_display.crop = box
    return box


def update_preview(obj: bpy.types.Object) -> None:
    """Give the crop box to the preview nodes, which draw the splats in renders."""
    box = crop_of(obj)
    splat_preview.set_input(obj, splat_preview.CROP_BOX, box)
    path = splat_preview.input_path(obj, splat_preview.CROP_HALF_EDGE)
    if path:
        obj.driver_remove(path)
        splat_preview.set_input(obj, splat_preview.CROP_HALF_EDGE, 1.0)
        if box is not None and box.type == "EMPTY":
            driver = present(cast(bpy.types.FCurve, obj.driver_add(path)).driver)
            driver.type = "SUM"
            variable = driver.variables.new()
            variable.targets[0].id = box
            variable.targets[0].data_path = "empty_display_size"
    splat_preview.follow_objects(obj)
