"""Write the heights of the run of the splats along a line, and show it."""

from collections.abc import Sequence
from typing import Annotated, Any

import bpy
from bpy.props import FloatVectorProperty
from mathutils import Vector

from ..swag_blender import maps
from ..swag_blender.blender_types import present, with_properties
from ..swag_blender.map_job import MapJob


@with_properties
class SWAG_OT_make_profile(MapJob):
    """Write a table and a diagram of the heights between two points, or two selected objects beside the splats"""

    bl_idname = "swag.make_profile"
    bl_label = "Profile"
    kind = "profile"

    first: Annotated[Sequence[float], FloatVectorProperty(name="From", size=3, options={"HIDDEN", "SKIP_SAVE"})]
    second: Annotated[Sequence[float], FloatVectorProperty(name="To", size=3, options={"HIDDEN", "SKIP_SAVE"})]

    def request(self, context: bpy.types.Context) -> dict[str, Any]:
        """The request with the line."""
        obj = present(context.active_object)
        if self.properties.is_property_set("first"):
            ends = [Vector(self.first), Vector(self.second)]
        else:
            ends = [other.matrix_world.translation.copy() for other in context.selected_objects if other != obj]
        return super().request(context) | {"line": maps.line_between(obj, ends)}


CLASSES = (SWAG_OT_make_profile,)
