"""Length of a metre in an imported scene, from a distance that the user knows."""

from collections.abc import Sequence

import bpy
from mathutils import Vector

from ..swag_engine.base.errors import InputError
from . import scene_import, splats
from .blender_types import present
from .properties import swag_of

METRES_KEY = "swag_metres_per_unit"
"""Property of a scene's root, or of splats without one: metres in a unit of its own space."""
SELECT_TWO = "Select two objects at different places, such as two cameras, or pick two points."


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


def selected_ends(context: bpy.types.Context) -> list[Vector]:
    """The places of the selected objects, whose distance is known where there are two of them."""
    return [obj.matrix_world.translation.copy() for obj in context.selected_objects]


def distance_between(ends: Sequence[Vector]) -> float:
    """Distance of two points in Blender units; 0 where there are more or fewer, or where they coincide."""
    length = (ends[1] - ends[0]).length if len(ends) == 2 else 0.0
    return length if length > 1e-9 else 0.0


def scale_to_distance(context: bpy.types.Context, ends: Sequence[Vector], distance: float) -> float:
    """Scale the scene about the world's origin so that two points of it are `distance` apart.

    Args:
        context: its scene has the unit scale, the metres in a Blender unit; one without units gets metres.
        ends: the two points, in Blender's world.
        distance: their distance afterwards, in Blender units, as Blender's properties of lengths have it.

    Returns:
        Metres in a unit of the scene's own space.

    Raises:
        InputError: they are not two points at different places.
    """
    length = distance_between(ends)
    if not length:
        raise InputError(SELECT_TWO)
    factor = distance / length
    obj, scene = present(scaled_object(context)), present(context.scene)
    if scene.unit_settings.system == "NONE":
        scene.unit_settings.system, scene.unit_settings.scale_length = "METRIC", 1.0
    metres = obj.matrix_world.median_scale * factor * scene.unit_settings.scale_length
    _scale_about_origin(obj, factor)
    obj[METRES_KEY] = metres
    swag_of(scene).metres_per_unit = metres
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
