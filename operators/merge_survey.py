"""Merge the blocks of a survey, and open the result."""

from pathlib import Path
from typing import Annotated, Any

import bpy
from bpy.props import BoolProperty

from ..swag_blender import survey
from ..swag_blender.blender_types import present, with_properties
from ..swag_blender.job import Job, can_run_engine


@with_properties
class SWAG_OT_merge_survey(Job):
    """Merge the trained blocks of the survey into tiles of several levels of detail, and open it"""

    bl_idname = "swag.merge_survey"
    bl_label = "Merge Survey"
    job = "Survey Merge"

    partial: Annotated[
        bool,
        BoolProperty(
            name="Finished Blocks Only",
            description="Leave out the blocks that are not finished; their places stay empty",
            options={"SKIP_SAVE"},
        ),
    ]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether a survey is chosen, the engine is there, and the job may start."""
        if survey.chosen_survey(present(context.scene)) is None:
            cls.poll_message_set("Choose the folder of a survey first")
            return False
        return can_run_engine(cls, context)

    def request(self, context: bpy.types.Context) -> dict[str, Any]:
        """The request for the merge."""
        path = survey.survey_path(present(context.scene))
        return {"request": "merge_survey", "survey": path, "partial": self.partial}

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        """Open the survey."""
        _, opened = survey.open_survey(context, Path(event["survey"]))
        return " ".join((opened, *event["notes"]))


CLASSES = (SWAG_OT_merge_survey,)
