"""Show the engine's log."""

from typing import Annotated

import bpy
from bpy.props import StringProperty

from ..swag_blender import job
from ..swag_blender.blender_types import OperatorResult, with_properties


@with_properties
class SWAG_OT_show_log(bpy.types.Operator):
    """Open the engine's log of the last job in a text editor"""

    bl_idname = "swag.show_log"
    bl_label = "Show Log"

    job: Annotated[
        str,
        StringProperty(
            name="Job", description="Name of the job; empty: the one that ended last", options={"SKIP_SAVE"}
        ),
    ]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether there is a log."""
        if not job.logs:
            cls.poll_message_set("No job has written a log yet")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Show the log."""
        job.show_log(context, self.job)
        return {"FINISHED"}


CLASSES = (SWAG_OT_show_log,)
