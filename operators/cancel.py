"""Stop a job that runs."""

from typing import Annotated, Any

import bpy
from bpy.props import StringProperty

from ..swag_blender.blender_types import OperatorResult, present, with_properties
from ..swag_blender.properties import SwagJob, status_of


@with_properties
class SWAG_OT_cancel(bpy.types.Operator):
    """Stop the running job; a training keeps its result so far"""

    bl_idname = "swag.cancel"
    bl_label = "Cancel"

    job: Annotated[
        str,
        StringProperty(
            name="Job", description="Name of the job; empty: the one that was started last", options={"SKIP_SAVE"}
        ),
    ]

    @classmethod
    def description(cls, context: bpy.types.Context, properties: Any) -> str:
        """Tooltip, another one for Stop Now; Blender calls this."""
        job = _chosen(context, properties.job)
        if job and job.stopping:
            return "Stop at once, without what is still to do; checkpoint and splats are kept"
        return present(cls.__doc__)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether a job runs."""
        if not status_of(context).job:
            cls.poll_message_set("No job is running")
            return False
        return True

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Ask for confirmation where the job goes on as yet."""
        job = _chosen(context, self.job)
        if job is None or job.stopping:
            return self.execute(context)
        self.job = job.name
        return present(context.window_manager).invoke_confirm(
            self,
            event,
            title=f"Stop {job.name}?",
            message="The result so far is kept, and Continue finishes it later" if job.name == "Training" else "",
            confirm_text="Stop",
        )

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Ask the job to stop, or to stop now where it is stopping."""
        job = _chosen(context, self.job)
        if job is None:  # it ended while the question was shown
            return {"CANCELLED"}
        job.stopping, job.stopping_now = True, job.stopping
        return {"FINISHED"}


def _chosen(context: bpy.types.Context, name: str) -> SwagJob | None:
    """The job of a name, the one that was started last for ""; None where it does not run."""
    status = status_of(context)
    return status.find(name or status.job)


CLASSES = (SWAG_OT_cancel,)
