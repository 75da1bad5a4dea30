"""Pick the line of a profile."""

import bpy
from mathutils import Vector

from ..swag_blender.blender_types import call_operator
from ..swag_blender.operator_base import splats_are_active
from ..swag_blender.point_tools import LineTool


class SWAG_OT_pick_profile(LineTool):
    """Click two points of the splats to write the heights between them"""

    bl_idname = "swag.pick_profile"
    bl_label = "Pick Profile"
    hint = "Click both ends of the profile; Escape: end"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the active object has splats."""
        return splats_are_active(cls, context)

    def on_line(self, context: bpy.types.Context, start: Vector, end: Vector) -> None:
        """Make the profile."""
        call_operator("make_profile", "INVOKE_DEFAULT", first=start, second=end)


CLASSES = (SWAG_OT_pick_profile,)
