"""Reset the user's choices of effects to the plan."""

import bpy

from ..swag_blender.blender_types import OperatorResult
from ..swag_blender.properties import swag_of


class SWAG_OT_reset_effects(bpy.types.Operator):
    """Follow the plan again in every effect"""

    bl_idname = "swag.reset_effects"
    bl_label = "Follow Plan"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether any choice differs from the plan."""
        if not swag_of(context.scene).plan.switches():
            cls.poll_message_set("Nothing differs from the plan")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Reset the choices."""
        for line in swag_of(context.scene).plan.lines:
            line.choice = "PLAN"
        return {"FINISHED"}


CLASSES = (SWAG_OT_reset_effects,)
