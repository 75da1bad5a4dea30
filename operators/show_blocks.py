"""Show the blocks of a survey as a map."""

import bpy

from ..swag_blender import survey
from ..swag_blender.blender_types import present
from ..swag_blender.operator_base import ReportingOperator
from ..swag_blender.survey_watch import show_blocks


class SWAG_OT_show_blocks(ReportingOperator):
    """Show the blocks of the survey in the 3D viewport, colored by their state, which is kept up to date"""

    bl_idname = "swag.show_blocks"
    bl_label = "Show Blocks"
    bl_options = {"UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether a survey is chosen."""
        cls.poll_message_set("Choose the folder of a survey first")
        return survey.chosen_survey(present(context.scene)) is not None

    def work(self, context: bpy.types.Context) -> str:
        """Make the map, or make it anew."""
        return show_blocks(context, present(survey.chosen_survey(present(context.scene))))


CLASSES = (SWAG_OT_show_blocks,)
