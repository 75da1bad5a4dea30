"""Length of a metre in an imported scene, from a distance that the user knows, or from coded targets."""

import os
from collections.abc import Sequence
from typing import Any

import bpy
from mathutils import Vector

from ..swag_engine.base.errors import InputError
from ..swag_engine.scene.georeference import describe_scale
from . import scene_import, splats
from .blender_types import present
from .georeference import METRES_KEY, apply_georeference, georeference_of, scale_about_origin, use_units
from .properties import swag_of

JOB = "Scale"
"""Name of the job that looks for targets."""
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
    use_units(scene)
    metres = obj.matrix_world.median_scale * factor * scene.unit_settings.scale_length
    scale_about_origin(obj, factor)
    obj[METRES_KEY] = metres
    swag_of(scene).metres_per_unit = metres
    return metres


def is_measured(context: bpy.types.Context) -> bool:
    """Whether the engine measured the scale of the imported scene, which trainings then take."""
    return georeference_of(scene_import.active_root(context)) is not None


def can_scale(operator: type[bpy.types.Operator], context: bpy.types.Context) -> bool:
    """Whether it is clear what to scale, for `poll` of an operator that needs it."""
    if scaled_object(context) is None:
        operator.poll_message_set("Import a scene or open splats; where there are several, select one of them")
        return False
    return True


def has_scene(cls: type[bpy.types.Operator], context: bpy.types.Context) -> bool:
    """Whether it is clear which imported scene is meant; tells the user where it is not."""
    if scene_import.active_root(context) is None:
        cls.poll_message_set("Import the scene first; where there are several, select one of them")
        return False
    return True


def scene_folder(context: bpy.types.Context) -> str:
    """Folder of the imported scene that the active object belongs to, or of the only one."""
    return os.path.abspath(present(scene_import.active_root(context))[scene_import.ROOT_KEY])


def targets_request(context: bpy.types.Context, family: str, size: float) -> dict[str, Any]:
    """The engine's request for the scale of the imported scene from coded targets.

    Args:
        context: its active object belongs to the scene, or there is only one.
        family: a name of the engine's families of targets.
        size: edge length of the targets in metres.

    """
    return {"request": "scale", "scene": scene_folder(context), "targets": family, "size": size}


def take_scale(scene_name: str, event: dict[str, Any]) -> str:
    """Scale an imported scene as a `scale` result says; returns what to tell the user.

    Args:
        scene_name: name of the Blender scene that was open when the scale was asked for.
        event: the event.

    Raises:
        InputError: the scene was removed.
    """
    scene = bpy.data.scenes.get(scene_name)
    folder = event["scene"]
    found = [root for root in scene_import.roots(scene) if root[scene_import.ROOT_KEY] == folder] if scene else []
    if not scene or not found:
        raise InputError(f"{folder} was removed; import it again: it then has the scale that was measured.")
    for root in found:
        apply_georeference(root, scene, event)
    swag_of(scene).metres_per_unit = 0.0  # the measured one
    return " ".join((f"{describe_scale(event)}.", *event["notes"]))
