"""Add a camera that passes through photos."""

from typing import Annotated

import bpy
from bpy.props import IntProperty

from ..swag_blender.blender_types import present, with_properties
from ..swag_blender.camera_moves import path_through_photos
from ..swag_blender.operator_base import ReportingOperator


@with_properties
class SWAG_OT_camera_path(ReportingOperator):
    """Add a camera that passes through the selected cameras in the order of their names"""

    bl_idname = "swag.camera_path"
    bl_label = "Camera Path Through Photos"
    bl_options = {"REGISTER", "UNDO"}

    frames: Annotated[
        int, IntProperty(name="Frames", description="Length of the film in frames", default=240, min=2, soft_max=2000)
    ]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether two cameras are selected, in object mode."""
        if context.mode != "OBJECT" or sum(obj.type == "CAMERA" for obj in context.selected_objects) < 2:
            cls.poll_message_set("Select two or more cameras in object mode first")
            return False
        return True

    def work(self, context: bpy.types.Context) -> str:
        """Add the camera."""
        cameras = [obj for obj in context.selected_objects if obj.type == "CAMERA"]
        camera = path_through_photos(context, cameras, self.frames)
        scene = present(context.scene)
        return (
            f"{camera.name} passes through {len(cameras)} cameras in frames {scene.frame_start} to {scene.frame_end}."
        )


CLASSES = (SWAG_OT_camera_path,)
