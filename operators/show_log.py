"""Show the engine's log."""

import bpy

from ..swag_blender import job
from ..swag_blender.blender_types import OperatorResult


class SWAG_OT_show_log(bpy.types.Operator):
    """Open the engine's log of the last job in a text editor"""

    bl_idname = "swag.show_log"
    bl_label = "Show Log"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether there is a log."""
        if not job.last_log:
            cls.poll_message_set("No job has written a log yet")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Show the log."""
        job.show_log(context)
        return {"FINISHED"}


CLASSES = (SWAG_OT_show_log,)
