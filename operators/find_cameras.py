"""Find the cameras of photos or of a video, and import them."""

from typing import Annotated, Any

import bpy
from bpy.props import BoolProperty, StringProperty

from ..swag_blender import find_cameras
from ..swag_blender.blender_types import OperatorResult, present, with_properties
from ..swag_blender.job import ImportJob
from ..swag_blender.properties import swag_of


@with_properties
class SWAG_OT_find_cameras(ImportJob):
    """Find out from which place each photo was taken, with COLMAP, and import the cameras"""

    bl_idname = "swag.find_cameras"
    bl_label = "Find Cameras"
    job = find_cameras.JOB

    filepath: Annotated[
        str,
        StringProperty(
            name="Photos or Video",
            description="Folder of photos, one of its photos, or a video",
            subtype="FILE_PATH",
            options={"SKIP_SAVE"},
        ),
    ]
    filter_folder: Annotated[bool, BoolProperty(default=True, options={"HIDDEN"})]
    filter_image: Annotated[bool, BoolProperty(default=True, options={"HIDDEN"})]
    filter_movie: Annotated[bool, BoolProperty(default=True, options={"HIDDEN"})]
    scene_folder: Annotated[
        str,
        StringProperty(
            name="Scene Folder",
            description="New folder for copies of the photos and their COLMAP model; empty: beside the photos or video",
            options={"SKIP_SAVE"},
        ),
    ]

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Ask for photos or a video where none are given."""
        if self.filepath:
            return self.execute(context)
        if chosen := swag_of(context.scene).scene_path:
            self.filepath = f"{chosen}/"  # where the file browser begins
        present(context.window_manager).fileselect_add(self)
        return {"RUNNING_MODAL"}

    def question(self) -> dict[str, Any]:
        """The request to find the cameras."""
        return find_cameras.make_request(self.filepath, self.scene_folder)


CLASSES = (SWAG_OT_find_cameras,)
