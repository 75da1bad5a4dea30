"""Import cameras that another program has found, with their photos."""

from typing import Annotated, Any

import bpy
from bpy.props import StringProperty

from ..swag_blender import camera_import
from ..swag_blender.blender_types import OperatorResult, present, with_properties
from ..swag_blender.job import ImportJob


@with_properties
class SWAG_OT_import_cameras(ImportJob):
    """Make a scene of cameras that Metashape, RealityScan, nerfstudio or another program has found, and import it"""

    bl_idname = "swag.import_cameras"
    bl_label = "Import Cameras"
    job = camera_import.JOB

    filepath: Annotated[
        str,
        StringProperty(
            name="Cameras",
            description="File with the cameras, such as the XML of Metashape or transforms.json",
            subtype="FILE_PATH",
            options={"SKIP_SAVE"},
        ),
    ]
    filter_glob: Annotated[str, StringProperty(default=camera_import.FILES, options={"HIDDEN"})]
    photos_folder: Annotated[
        str,
        StringProperty(
            name="Photos",
            description="Folder with the photos of these cameras; empty: the folder of the file",
            options={"SKIP_SAVE"},
        ),
    ]
    points_file: Annotated[
        str,
        StringProperty(
            name="Points",
            description="PLY file of points in the coordinates of the cameras; empty: those of the file or the photos",
            options={"SKIP_SAVE"},
        ),
    ]
    scene_folder: Annotated[
        str,
        StringProperty(
            name="Scene Folder",
            description="New folder for copies of the photos and their cameras; empty: beside the file",
            options={"SKIP_SAVE"},
        ),
    ]

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Ask for the file where none is given."""
        if self.filepath:
            return self.execute(context)
        present(context.window_manager).fileselect_add(self)
        return {"RUNNING_MODAL"}

    def question(self) -> dict[str, Any]:
        """The request to make the scene."""
        return camera_import.make_request(self.filepath, self.photos_folder, self.points_file, self.scene_folder)


def draw_import(layout: bpy.types.UILayout) -> None:
    """Draw the line in File > Import."""
    layout.operator(SWAG_OT_import_cameras.bl_idname, text="Cameras of Another Program (.xml/.json/.csv)")


CLASSES = (SWAG_OT_import_cameras,)
