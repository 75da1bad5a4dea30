"""The crop box of a splat object: another object whose box limits what is shown, selected, rendered and exported.

The box is the cube from -1 to 1 of that object's own space; for an empty, times its display size. Moving, rotating and
scaling the object changes the crop; the splats are never changed by it.
"""

import bpy
import numpy as np
from mathutils import Matrix

from ..swag_engine.base.errors import InputError
from ..swag_engine.formats.select import inside_box
from . import splats
from .blender_types import present
from .display import display_of

PERCENTILES = (1.0, 99.0)
"""Range of coordinates, on each axis, that a new box encloses: single splats far away do not make it large."""
MARGIN = 1.05
"""Size of a new box, as a multiple of that range."""
MIN_THICKNESS = 0.01
"""Shortest edge of a new box, as a fraction of its longest, so that a flat scene has a box with a volume."""


def crop_of(obj: bpy.types.Object) -> bpy.types.Object | None:
    """The object that crops a splat object; None where there is none."""
    return display_of(obj).crop


def world_to_box(obj: bpy.types.Object) -> np.ndarray | None:
    """Matrix (4, 4) from Blender's world to a space in which the object's crop box reaches from -1 to 1.

    None without a crop box. A box without volume, as after scaling it to zero, does not crop either.
    """
    box = crop_of(obj)
    if box is None:
        return None
    half_edge = box.empty_display_size if box.type == "EMPTY" else 1.0
    matrix = np.array(box.matrix_world, np.float64) @ np.diag([half_edge] * 3 + [1.0])
    return np.linalg.inv(matrix) if np.linalg.det(matrix[:3, :3]) else None


def inside_crop(obj: bpy.types.Object) -> np.ndarray:
    """Mask (N,) bool of the splats whose centre is in the object's crop box; all splats without one."""
    to_box = world_to_box(obj)
    if to_box is None:
        return np.ones(splats.count(obj), bool)
    return inside_box(splats.positions(obj), to_box @ np.array(obj.matrix_world, np.float64))


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
        display_of(obj).crop = box
    return box
