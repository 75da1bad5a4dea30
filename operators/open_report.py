"""Open the report of a run."""

import os
from pathlib import Path
from typing import Annotated, Any

import bpy
from bpy.props import StringProperty

from ..swag_blender import run_list
from ..swag_blender.blender_types import OperatorResult, present, with_properties
from ..swag_blender.job import Job, can_run_engine
from ..swag_blender.operator_base import ReportingOperator
from ..swag_blender.web_page import open_page


@with_properties
class SWAG_OT_open_report(Job, ReportingOperator):
    """Open the report of the run in the web browser: images beside photos, curves, settings"""

    bl_idname = "swag.open_report"
    bl_label = "Open Report"
    bl_options = set()
    job = "Report"

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
        """Whether the shown run has a report, or the engine can write it."""
        shown = run_list.shown_run(context)
        if shown is None:
            cls.poll_message_set("There is no run in the scene: train, or open a run")
            return False
        folder = run_list.folder_of(shown)
        if run_list.report_of(folder).is_file():
            return True
        if not any(folder.glob("checkpoint-*.safetensors")):
            cls.poll_message_set("The run has no report yet: it is written at the end of the training")
            return False
        return can_run_engine(cls, context, os.path.abspath(folder))

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Open the report, or let the engine write it first."""
        return self.execute(context)

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Open the report, or let the engine write it first."""
        written = run_list.report_of(self._run(context)).is_file()
        return ReportingOperator.execute(self, context) if written else super().execute(context)

    def work(self, context: bpy.types.Context) -> str:
        """Open the report."""
        open_page(run_list.report_of(self._run(context)))
        return ""

    def request(self, context: bpy.types.Context) -> dict[str, Any]:
        """The request to write the report."""
        return {"request": "report", "run": str(self._run(context))}

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        """Open the report."""
        open_page(Path(event["report"]))
        return f"The report was written: {event['report']}"

    def _run(self, context: bpy.types.Context) -> Path:
        """The chosen folder, else that of the shown run."""
        chosen = bpy.path.abspath(self.folder)
        return Path(chosen) if chosen else run_list.folder_of(present(run_list.shown_run(context)))


CLASSES = (SWAG_OT_open_report,)
