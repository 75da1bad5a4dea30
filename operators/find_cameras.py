"""Find the cameras of photos or of a video, and import them."""

import tempfile
from typing import Annotated, Any

import bpy
from bpy.props import BoolProperty, StringProperty

from ..swag_blender import find_cameras, scene_import
from ..swag_blender.blender_types import OperatorResult, present, with_properties
from ..swag_blender.engine_process import Engine
from ..swag_blender.job import Job, can_run_engine
from ..swag_blender.properties import swag_of


@with_properties
class SWAG_OT_find_cameras(Job):
    """Find out from which place each photo was taken, with COLMAP, and import the cameras"""

    bl_idname = "swag.find_cameras"
    bl_label = "Find Cameras"
    bl_options = {"UNDO"}  # without REGISTER, as Adjust Last Operation would find them again
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

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the engine is there and no job runs."""
        return can_run_engine(cls, context)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Ask for photos or a video where none are given."""
        if self.filepath:
            return self.execute(context)
        if chosen := swag_of(context.scene).scene_path:
            self.filepath = f"{chosen}/"  # where the file browser begins
        present(context.window_manager).fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Find them: for a script until it is done, for a user without blocking the window."""
        if bpy.app.background or not self.options.is_invoke:
            return self.run_blocking(context)
        return self.run_modal(context)

    def start(self, context: bpy.types.Context) -> Engine:
        """Ask the engine to find the cameras."""
        request = find_cameras.make_request(self.filepath, self.scene_folder)
        self._scene = present(context.scene).name
        self._arrays = tempfile.TemporaryDirectory()
        engine = Engine()
        engine.send(request | {"arrays": self._arrays.name})
        return engine

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        """Import them."""
        with self._arrays:
            _, message = scene_import.add_to_scene(self._scene, event)
        return message


CLASSES = (SWAG_OT_find_cameras,)
