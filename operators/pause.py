"""Pause and resume the training that runs."""

import bpy

from ..swag_blender.blender_types import OperatorResult, present
from ..swag_blender.properties import status_of


class SWAG_OT_pause(bpy.types.Operator):
    """Pause the training, or resume it; the result is the same as without a pause"""

    bl_idname = "swag.pause"
    bl_label = "Pause or Resume"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether a training runs that was not asked to stop."""
        training = status_of(context).find("Training")
        if training is None or training.stopping:
            cls.poll_message_set("No training is running")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Switch between running and paused."""
        training = present(status_of(context).find("Training"))
        training.paused = not training.paused
        return {"FINISHED"}


CLASSES = (SWAG_OT_pause,)
