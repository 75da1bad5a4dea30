"""Copy the command that trains a survey."""

from typing import Annotated, Any

import bpy
from bpy.props import BoolProperty

from ..swag_blender import survey
from ..swag_blender.blender_types import present, with_properties
from ..swag_blender.operator_base import ReportingOperator


@with_properties
class SWAG_OT_copy_survey_command(ReportingOperator):
    """Copy the command that trains the survey with the Python of the engine, for a terminal of any machine"""

    bl_idname = "swag.copy_survey_command"
    bl_label = "Copy Survey Command"

    blender: Annotated[
        bool,
        BoolProperty(
            name="This Blender", description="Run the engine of this Blender's extension", options={"SKIP_SAVE"}
        ),
    ]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether a survey is chosen."""
        cls.poll_message_set("Choose the folder of a survey first")
        return survey.chosen_survey(present(context.scene)) is not None

    @classmethod
    def description(cls, context: bpy.types.Context, properties: Any) -> str:
        """Tooltip, another one for this Blender; Blender calls this."""
        if properties.blender:
            return "Copy the command that trains the survey with this Blender, for a terminal of this machine"
        return present(cls.__doc__)

    def work(self, context: bpy.types.Context) -> str:
        """Copy it."""
        command = survey.run_command(survey.survey_path(present(context.scene)), self.blender)
        present(context.window_manager).clipboard = command
        return f"Copied: {command}"


CLASSES = (SWAG_OT_copy_survey_command,)
