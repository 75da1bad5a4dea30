"""Add a camera that goes around the splats."""

import math
from typing import Annotated

import bpy
from bpy.props import FloatProperty, IntProperty

from ..swag_blender import film
from ..swag_blender.blender_types import present, with_properties
from ..swag_blender.camera_moves import add_turntable
from ..swag_blender.operator_base import ReportingOperator


@with_properties
class SWAG_OT_add_turntable(ReportingOperator):
    """Add a camera that goes around the selected objects or splats, around all splats where none are selected"""

    bl_idname = "swag.add_turntable"
    bl_label = "Add Turntable"
    bl_options = {"REGISTER", "UNDO"}

    frames: Annotated[
        int, IntProperty(name="Frames", description="Length of the film in frames", default=240, min=2, soft_max=2000)
    ]
    angle: Annotated[
        float,
        FloatProperty(
            name="Sweep",
            description="How far the camera goes; below a full circle it stays on the side of the photos",
            subtype="ANGLE",
            default=math.tau,
            min=-math.tau,
            max=math.tau,
        ),
    ]
    elevation: Annotated[
        float,
        FloatProperty(
            name="Elevation",
            description="Height of the camera as an angle above the horizon",
            subtype="ANGLE",
            default=math.radians(20),
            min=math.radians(-89),
            max=math.radians(89),
        ),
    ]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether there is something to go around, in object mode."""
        if context.mode != "OBJECT" or not (context.selected_objects or film.shown_objects(context)):
            cls.poll_message_set("There are no splats and no selected objects in object mode")
            return False
        return True

    def work(self, context: bpy.types.Context) -> str:
        """Add the camera."""
        objects = [obj for obj in context.selected_objects if obj.type not in {"CAMERA", "LIGHT", "EMPTY"}]
        camera = add_turntable(context, objects or film.shown_objects(context), self.frames, self.angle, self.elevation)
        scene = present(context.scene)
        return f"{camera.name} is the scene's camera in frames {scene.frame_start} to {scene.frame_end}."


CLASSES = (SWAG_OT_add_turntable,)
