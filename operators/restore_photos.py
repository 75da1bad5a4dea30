"""Write the photos of a run without water."""

from typing import Any

import bpy

from ..swag_blender import restored_photos
from ..swag_blender.blender_types import present
from ..swag_blender.job import Job, can_run_engine
from ..swag_blender.operator_base import active_run, splats_are_active


class SWAG_OT_restore_photos(Job):
    """Write the photos of the run without water to its folder restored_photos, in the colors of the panel Color"""

    bl_idname = "swag.restore_photos"
    bl_label = "Restore Photos"
    job = restored_photos.JOB

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the active object has splats, the engine is there, and the job may start."""
        return can_run_engine(cls, context, active_run(context)) and splats_are_active(cls, context)

    def request(self, context: bpy.types.Context) -> dict[str, Any]:
        """The request for the run of the splats."""
        return restored_photos.request(present(context.scene), present(context.active_object))

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        """Say how many photos were written, and where they are."""
        count = event["photos"]
        return f"{count} photo{'s' if count > 1 else ''} without water: {event['out']}"


CLASSES = (SWAG_OT_restore_photos,)
