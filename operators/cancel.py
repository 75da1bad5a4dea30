"""Stop the job that runs."""

import bpy

from ..swag_blender.blender_types import OperatorResult, present
from ..swag_blender.properties import status_of


class SWAG_OT_cancel(bpy.types.Operator):
    """Stop the running job; a training keeps its result so far"""

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

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Ask for confirmation."""
        job = status_of(context).job
        return present(context.window_manager).invoke_confirm(
            self,
            event,
            title=f"Stop {job}?",
            message="The result so far is kept, and Continue finishes it later" if job == "Training" else "",
            confirm_text="Stop",
        )

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Ask the job to stop."""
        status = status_of(context)
        if not status.job:  # it ended while the question was shown
            return {"CANCELLED"}
        status.stopping, status.text = True, "Stopping"
        return {"FINISHED"}


CLASSES = (SWAG_OT_cancel,)
