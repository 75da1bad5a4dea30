"""Stop the job that runs, with what exists kept, or hold it for a while."""

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


class SWAG_OT_pause(bpy.types.Operator):
    """Hold the training where it is, or let a held one go on; its result is the same as without"""

    bl_idname = "swag.pause"
    bl_label = "Pause or Go On"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        status = context.window_manager.swag
        cls.poll_message_set("No training is running")
        return status.job == "Training" and not status.stopping

    def execute(self, context: bpy.types.Context) -> set[str]:
        status = context.window_manager.swag
        status.paused = not status.paused
        return {"FINISHED"}


CLASSES = (SWAG_OT_cancel, SWAG_OT_pause)
