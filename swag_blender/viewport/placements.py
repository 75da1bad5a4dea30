"""Which splat objects a viewport shows, and where: objects themselves and instances of collections."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np

from .. import splats
from ..blender_types import present
from ..display import display_of


@dataclass(frozen=True)
class Placement:
    """A splat object in one place.

    Attributes:
        obj: The object.
        to_world: (4, 4) from its own space to the world.
    """

    obj: bpy.types.Object
    to_world: np.ndarray


def is_drawn(obj: bpy.types.Object) -> bool:
    """Whether the extension draws the object's splats, in viewports that Blender does not draw them in."""
    return splats.is_splats(obj) and display_of(obj).style == "SPLATS"


def drawn_objects(view_layer: bpy.types.ViewLayer) -> list[bpy.types.Object]:
    """The splat objects of a view layer that the extension draws, in any viewport, each once."""
    found = [obj for obj in view_layer.objects if is_drawn(obj)]
    for obj in view_layer.objects:
        found += [one.obj for one in _instances(obj, np.eye(4), None)]
    return list(dict.fromkeys(found))


def placements(context: bpy.types.Context) -> list[Placement]:
    """What the 3D viewport of the context shows, without what is hidden there or outside its local view."""
    space: Any = context.space_data
    depsgraph = context.evaluated_depsgraph_get()
    if not space.show_object_viewport_pointcloud:
        return []
    found = []
    for obj in present(context.view_layer).objects:
        instancer = obj.instance_type == "COLLECTION" and obj.instance_collection is not None
        if not (instancer or is_drawn(obj)) or not obj.visible_in_viewport_get(space):
            continue
        # The evaluated matrix has parents, constraints and animation in it.
        to_world = np.array(obj.evaluated_get(depsgraph).matrix_world, np.float64)
        if is_drawn(obj):
            found.append(Placement(obj, to_world))
        found += _instances(obj, to_world, depsgraph)
    return found


def _instances(
    instancer: bpy.types.Object, to_world: np.ndarray, depsgraph: bpy.types.Depsgraph | None
) -> Iterator[Placement]:
    """The splat objects in the collection that an object instances, and in those that these instance."""
    collection = instancer.instance_collection
    if instancer.instance_type != "COLLECTION" or collection is None:
        return
    offset = np.eye(4)
    offset[:3, 3] = -np.array(collection.instance_offset)
    for obj in collection.all_objects:
        own = obj.matrix_world if depsgraph is None else obj.evaluated_get(depsgraph).matrix_world
        placed = to_world @ offset @ np.array(own, np.float64)
        if is_drawn(obj) and not obj.hide_viewport:
            yield Placement(obj, placed)
        yield from _instances(obj, placed, depsgraph)
