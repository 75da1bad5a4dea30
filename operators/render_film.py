"""Render the camera animation with the engine."""

from typing import Any

import bpy

from ..swag_blender import film
from ..swag_blender.blender_types import present
from ..swag_blender.engine_process import Engine
from ..swag_blender.job import Job


class SWAG_OT_render_film(Job):
    """Render the splats for each frame of the scene with the engine, as they were trained, to images or a video"""

    bl_idname = "swag.render_film"
    bl_label = "Render Film"
    job = "Film"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the scene has a camera and splats are shown, and the job may start."""
        if not super().poll(context):
            return False
        if not film.shown_objects(context):
            cls.poll_message_set("There are no splats that are shown in the viewport and in renders")
            return False
        if present(context.scene).camera is None:
            cls.poll_message_set("The scene has no camera: add a turntable or a camera path")
            return False
        return True

    def start(self, context: bpy.types.Context) -> Engine:
        """Start the engine."""
        return film.FilmEngine(context)

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        """Say how many frames were rendered, and where they are."""
        return str(event["text"])


CLASSES = (SWAG_OT_render_film,)
