"""Open a merged survey."""

from pathlib import Path
from typing import Annotated

import bpy
from bpy.props import StringProperty

from ..swag_blender import survey
from ..swag_blender.blender_types import OperatorResult, present, with_properties
from ..swag_blender.operator_base import ReportingOperator


@with_properties
class SWAG_OT_open_survey(ReportingOperator):
    """Open a merged survey: the finest level of detail that fits the number of splats, its water and its colors"""

    bl_idname = "swag.open_survey"
    bl_label = "Open Survey"
    bl_options = {"UNDO"}

    filepath: Annotated[str, StringProperty(subtype="FILE_PATH", options={"SKIP_SAVE", "HIDDEN"})]
    directory: Annotated[
        str,
        StringProperty(
            name="Folder",
            description="Folder of the survey, which has survey.json",
            subtype="DIR_PATH",
            options={"SKIP_SAVE"},
        ),
    ]
    filter_glob: Annotated[str, StringProperty(default="survey.json", options={"HIDDEN"})]

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Ask for the folder where none is given."""
        if self.filepath or self.directory:
            return self.execute(context)
        present(context.window_manager).fileselect_add(self)
        return {"RUNNING_MODAL"}

    def work(self, context: bpy.types.Context) -> str:
        """Open the survey."""
        return survey.open_survey(context, Path(bpy.path.abspath(self.filepath or self.directory)))[1]


def draw_import(layout: bpy.types.UILayout) -> None:
    """Draw the line in File > Import."""
    layout.operator(SWAG_OT_open_survey.bl_idname, text="SWAG Survey (folder)")


CLASSES = (SWAG_OT_open_survey,)
