"""Scale, axes and coordinates that the engine measured, on the objects of an imported scene."""

import json
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ..swag_engine.scene.georeference import Georeference, Placement

METRES_KEY = "swag_metres_per_unit"
"""Property of a scene's root, or of splats without one: metres in a unit of its own space."""
GEOREFERENCE_KEY = "swag_georeference"
"""Property of a scene's root: the document of its scale.json, as JSON."""
PLACEMENT_KEY = "swag_placement"
"""Property of splats in a metric frame of their own: where it lies, as JSON, which keeps doubles."""


def apply_georeference(root: bpy.types.Object, scene: bpy.types.Scene, document: dict[str, Any]) -> None:
    """Give an imported scene its measured scale and, where they were measured, its axes and coordinates.

    Args:
        root: the root of the imported scene.
        scene: its unit scale is the metres in a Blender unit; one without units gets metres.
        document: the engine's document of scale.json.
    """
    measured = Georeference.from_json(document)
    use_units(scene)
    unit = scene.unit_settings.scale_length
    factor = measured.metres_per_unit / unit / root.matrix_world.median_scale
    scale_about_origin(root, factor)
    if measured.axes != "estimated" or measured.placement:
        root.matrix_world = Matrix((np.diag([1 / unit] * 3 + [1.0]) @ measured.matrix).tolist())
    root[METRES_KEY] = measured.metres_per_unit
    root[GEOREFERENCE_KEY] = json.dumps(measured.to_json())


def georeference_of(root: bpy.types.Object | None) -> Georeference | None:
    """The measured scale of an imported scene; None where there is none."""
    stored = root.get(GEOREFERENCE_KEY) if root else None
    return None if stored is None else Georeference.from_json(json.loads(stored))


def remember_placement(obj: bpy.types.Object, placement: Placement) -> None:
    """Store with splats where their own frame, metres with z up, lies."""
    obj[PLACEMENT_KEY] = json.dumps(placement.to_json())
    obj[METRES_KEY] = 1.0


def placement_of(obj: bpy.types.Object) -> Placement | None:
    """Where the own frame of splats lies; None where they have none."""
    stored = obj.get(PLACEMENT_KEY)
    return None if stored is None else Placement.from_json(json.loads(stored))


def use_units(scene: bpy.types.Scene) -> None:
    """Give a Blender scene without units metres."""
    if scene.unit_settings.system == "NONE":
        scene.unit_settings.system, scene.unit_settings.scale_length = "METRIC", 1.0


def scale_about_origin(obj: bpy.types.Object, factor: float) -> None:
    """Scale an object and the clipping distances of the cameras below it about the world's origin."""
    scaled = obj.matrix_world.copy() * factor
    scaled[3] = (0.0, 0.0, 0.0, 1.0)
    obj.matrix_world = scaled
    for child in obj.children_recursive:
        if isinstance(child.data, bpy.types.Camera):
            child.data.clip_start *= factor
            child.data.clip_end *= factor
