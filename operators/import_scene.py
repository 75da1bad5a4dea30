"""Import a COLMAP scene: cameras with their photos, the sparse cloud, upright near the origin."""

from pathlib import Path
from typing import Annotated, Any

import bpy
from bpy.props import BoolProperty, StringProperty

from ..swag_blender.blender_types import OperatorResult, present, with_properties
from ..swag_blender.engine_process import EngineError
from ..swag_blender.job import ImportJob


@with_properties
class SWAG_OT_import_scene(ImportJob):
    """Import the cameras, the photos and the points of a COLMAP reconstruction"""

    bl_idname = "swag.import_scene"
    bl_label = "Import COLMAP Scene"
    job = "Import"

    directory: Annotated[
        str,
        StringProperty(name="Folder", description="Folder with the photos and their cameras", subtype="DIR_PATH"),
    ]
    filter_folder: Annotated[bool, BoolProperty(default=True, options={"HIDDEN"})]

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Ask for the folder where none is given."""
        if self.directory:
            return self.execute(context)
        present(context.window_manager).fileselect_add(self)
        return {"RUNNING_MODAL"}

    def question(self) -> dict[str, Any]:
        """The request to inspect the folder."""
        if not self.directory:
            raise EngineError("Choose the folder with the photos and their COLMAP model first.")
        folder = str(Path(bpy.path.abspath(self.directory)).absolute())
        return {"request": "inspect", "scene": folder}


def draw_import(layout: bpy.types.UILayout) -> None:
    """Draw the line in File > Import."""
    layout.operator(SWAG_OT_import_scene.bl_idname, text="COLMAP Scene (folder)")


CLASSES = (SWAG_OT_import_scene,)
