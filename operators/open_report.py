"""Open the report of a run."""

from typing import Annotated

import bpy
from bpy.props import StringProperty

from ..swag_blender import run_list
from ..swag_blender.blender_types import with_properties
from ..swag_blender.operator_base import ReportingOperator


@with_properties
class SWAG_OT_open_report(ReportingOperator):
    """Open the report of the run in the web browser: images beside photos, curves, settings"""

    bl_idname = "swag.open_report"
    bl_label = "Open Report"

    folder: Annotated[
        str,
        StringProperty(
            name="Run",
            description="Folder of the run; empty: the run of the active object",
            subtype="DIR_PATH",
            options={"SKIP_SAVE"},
        ),
    ]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the shown run has a report."""
        if run_list.shown_run(context) is None:
            cls.poll_message_set("There is no run in the scene: train, or open a run")
            return False
        if not run_list.has_report(context):
            cls.poll_message_set("The run has no report yet: it is written at the end of the training")
            return False
        return True

    def work(self, context: bpy.types.Context) -> str:
        """Open the page."""
        run_list.open_report(context, bpy.path.abspath(self.folder))
        return ""


CLASSES = (SWAG_OT_open_report,)
