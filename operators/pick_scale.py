"""Pick two points of the splats whose distance is known, and scale the scene by it."""

import bpy
from mathutils import Vector

from ..swag_blender import scale
from ..swag_blender.blender_types import call_operator
from ..swag_blender.point_tools import LineTool


class SWAG_OT_pick_scale(LineTool):
    """Click two points of the splats whose distance you know; the scene is then scaled by it"""

    bl_idname = "swag.pick_scale"
    bl_label = "Pick Two Points"
    bl_options = {"REGISTER"}
    hint = "Click two points whose distance you know; Escape: cancel"
    cursor = "EYEDROPPER"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the scene shows splats and can be scaled."""
        return super().poll(context) and scale.can_scale(cls, context)

    def on_line(self, context: bpy.types.Context, start: Vector, end: Vector) -> None:
        """Ask for the distance."""
        call_operator("set_scale", "INVOKE_DEFAULT", start=start, end=end)


CLASSES = (SWAG_OT_pick_scale,)
