"""Stop the job that runs; what exists so far is kept."""

import bpy


class SWAG_OT_cancel(bpy.types.Operator):
    """Stop what is running and keep what exists so far"""

    bl_idname = "swag.cancel"
    bl_label = "Cancel"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        status = context.window_manager.swag
        if status.stopping:
            cls.poll_message_set("It is stopping already")
        return bool(status.job) and not status.stopping

    def execute(self, context: bpy.types.Context) -> set[str]:
        status = context.window_manager.swag
        status.stopping, status.text = True, "Stopping"
        return {"FINISHED"}


CLASSES = (SWAG_OT_cancel,)
