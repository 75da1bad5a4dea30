"""Plan a survey of the chosen photos."""

from pathlib import Path
from typing import Any

import bpy

from ..swag_blender.blender_types import present
from ..swag_blender.job import Job, can_work_on_photos, chosen_scene
from ..swag_blender.properties import swag_of
from ..swag_blender.survey import find_survey, plan_request
from ..swag_blender.survey_watch import show_blocks


class SWAG_OT_plan_survey(Job):
    """Divide the photos into blocks that are trained one by one, on one machine or several"""

    bl_idname = "swag.plan_survey"
    bl_label = "Plan Survey"
    job = "Survey Plan"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether photos are chosen, the engine is there, and the job may start."""
        return can_work_on_photos(cls, context)

    def request(self, context: bpy.types.Context) -> dict[str, Any]:
        """The request for the plan."""
        return plan_request(context) | {"scene": chosen_scene(swag_of(present(context.scene)))}

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        """Show the map of the blocks."""
        return show_blocks(context, find_survey(Path(event["survey"])))


CLASSES = (SWAG_OT_plan_survey,)
