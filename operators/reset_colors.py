"""Reset the colors of splats to the automatic development."""

import bpy

from ..swag_blender.blender_types import OperatorResult
from ..swag_blender.colors import colors_of


class SWAG_OT_reset_colors(bpy.types.Operator):
    """Go back to the automatic development, without own exposure, white balance and contrast"""

    bl_idname = "swag.reset_colors"
    bl_label = "Reset Colors"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Reset the colors of the scene."""
        colors_of(context.scene).reset()
        return {"FINISHED"}


CLASSES = (SWAG_OT_reset_colors,)
