"""Length of a metre in an imported scene, from a distance that the user knows."""

from collections.abc import Sequence

import bpy
import numpy as np
from mathutils import Vector

from ..swag_engine.base.errors import InputError
from . import scene_import, splats
from .blender_types import present
from .properties import swag_of

METRES_KEY = "swag_metres_per_unit"
"""Property of a scene's root, or of splats without one: metres in a unit of its own space."""


def scaled_object(context: bpy.types.Context) -> bpy.types.Object | None:
    """The object that a known distance scales: the root of the imported scene, else the splats; None if unclear."""
    if root := scene_import.active_root(context):
        return root
    if splats.is_splats(context.active_object):
        return context.active_object
    found = [obj for obj in present(context.scene).objects if splats.is_splats(obj)]
    return found[0] if len(found) == 1 else None


def metres_per_unit(obj: bpy.types.Object) -> float:
    """Metres in a unit of the splats' own space; 0 where the scale was never set."""
    root = scene_import.find_root(obj) or obj
    return float(root.get(METRES_KEY, 0.0))


def scale_by_selection(context: bpy.types.Context, distance: float) -> float:
    """Scale the scene so that the two selected objects are `distance` metres apart; as scale_to_distance."""
    ends = [obj.matrix_world.translation for obj in context.selected_objects]
    if len(ends) != 2:
        raise InputError("Select two objects at different places, such as two cameras, or pick two points.")
    return scale_to_distance(context, ends[0], ends[1], distance)


def scale_to_distance(
    context: bpy.types.Context, start: Vector | Sequence[float], end: Vector | Sequence[float], distance: float
) -> float:
    """Scale the scene about the world's origin so that two points of it are `distance` metres apart.

    Returns:
        Metres in a unit of the scene's own space; a Blender unit is a metre afterwards.

    Raises:
        InputError: the points coincide.
    """
    length = float(np.linalg.norm(np.array(end) - np.array(start)))
    if length < 1e-9:
        raise InputError("Select two objects at different places, such as two cameras, or pick two points.")
    obj = present(scaled_object(context))
    metres = obj.matrix_world.median_scale * distance / length
    _scale_about_origin(obj, metres / obj.matrix_world.median_scale)
    obj[METRES_KEY] = metres
    scene = present(context.scene)
    swag_of(scene).metres_per_unit = metres
    scene.unit_settings.system = "METRIC"
    return metres


def _scale_about_origin(obj: bpy.types.Object, factor: float) -> None:
    """Scale an object and the clipping distances of the cameras below it about the world's origin."""
    scaled = obj.matrix_world.copy() * factor
    scaled[3] = (0.0, 0.0, 0.0, 1.0)
    obj.matrix_world = scaled
    for child in obj.children_recursive:
        if isinstance(child.data, bpy.types.Camera):
            child.data.clip_start *= factor
            child.data.clip_end *= factor
