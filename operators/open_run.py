"""Open the folder of a run, through the menu, the sidebar, or dropped into the window."""

from pathlib import Path
from typing import Annotated

import bpy
from bpy.props import StringProperty

from ..swag_blender import open_run
from ..swag_blender.blender_types import OperatorResult, present, with_properties
from ..swag_blender.operator_base import ReportingOperator


@with_properties
class SWAG_OT_open_run(ReportingOperator):
    """Open a training run: its splats, water, labels and figures, and the cameras of its photos"""

    bl_idname = "swag.open_run"
    bl_label = "Open Run"
    bl_options = {"UNDO"}

    filepath: Annotated[str, StringProperty(subtype="FILE_PATH", options={"SKIP_SAVE", "HIDDEN"})]
    directory: Annotated[
        str,
        StringProperty(
            name="Folder",
            description="Folder of the run, which has config.json and result.ply",
            subtype="DIR_PATH",
            options={"SKIP_SAVE"},
        ),
    ]
    filter_glob: Annotated[str, StringProperty(default="config.json", options={"HIDDEN"})]

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Ask for the folder where none is given."""
        if self.filepath or self.directory:
            return self.execute(context)
        present(context.window_manager).fileselect_add(self)
        return {"RUNNING_MODAL"}

    def work(self, context: bpy.types.Context) -> str:
        """Open the run, and import its photos where they are not in the scene."""
        obj, opened = open_run.open_run(context, Path(bpy.path.abspath(self.filepath or self.directory)))
        missing = open_run.import_cameras(obj, present(context.scene))
        return f"{opened} {missing}".strip()


class SWAG_FH_run(bpy.types.FileHandler):
    """The config.json of a run dropped into the 3D view"""

    bl_idname = "SWAG_FH_run"
    bl_label = "Training Run"
    bl_import_operator = SWAG_OT_open_run.bl_idname
    bl_file_extensions = ".json"

    @classmethod
    def poll_drop(cls, context: bpy.types.Context | None) -> bool:
        """Whether files can be dropped here."""
        return context is not None and context.area is not None and context.area.type in {"VIEW_3D", "OUTLINER"}


def draw_import(layout: bpy.types.UILayout) -> None:
    """Draw the line in File > Import."""
    layout.operator(SWAG_OT_open_run.bl_idname, text="SWAG Run (folder)")


CLASSES = (SWAG_OT_open_run, SWAG_FH_run)
