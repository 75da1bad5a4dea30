"""Merge the blocks of a survey, and open the result."""

from pathlib import Path
from typing import Any

import bpy

from ..swag_blender import survey
from ..swag_blender.blender_types import present
from ..swag_blender.job import Job, can_run_engine


class SWAG_OT_merge_survey(Job):
    """Merge the trained blocks of the survey into tiles of several levels of detail, and open it"""

    bl_idname = "swag.merge_survey"
    bl_label = "Merge Survey"
    job = "Survey Merge"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether a survey is chosen, the engine is there and no job runs."""
        if survey.chosen_survey(present(context.scene)) is None:
            cls.poll_message_set("Choose the folder of a survey first")
            return False
        return can_run_engine(cls, context)

    def request(self, context: bpy.types.Context) -> dict[str, Any]:
        """The request for the merge."""
        return {"request": "merge_survey", "survey": survey.survey_path(present(context.scene))}

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        """Open the survey."""
        return survey.open_survey(context, Path(event["survey"]))[1]


CLASSES = (SWAG_OT_merge_survey,)
