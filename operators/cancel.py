"""Stop the job that runs."""

import bpy

from ..swag_blender.blender_types import OperatorResult
from ..swag_blender.properties import status_of


class SWAG_OT_cancel(bpy.types.Operator):
    """Stop the running job and keep its result so far"""

    bl_idname = "swag.cancel"
    bl_label = "Cancel"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether a job runs that was not asked to stop."""
        status = status_of(context)
        if not status.job or status.stopping:
            cls.poll_message_set("The job is stopping already" if status.stopping else "No job is running")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Ask the job to stop."""
        status = status_of(context)
        status.stopping, status.text = True, "Stopping"
        return {"FINISHED"}


CLASSES = (SWAG_OT_cancel,)
