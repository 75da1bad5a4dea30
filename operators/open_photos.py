"""Open photos or a video: import their cameras, or find them where there are none."""

from typing import Any

import bpy

from ..swag_blender.blender_types import OperatorResult
from ..swag_blender.find_cameras import JOB, PhotosJob, scene_of_photos


class SWAG_OT_open_photos(PhotosJob):
    """Choose a folder of photos or a video; from which place each photo was taken is read, or found out"""

    bl_idname = "swag.open_photos"
    bl_label = "Photos or Video"
    job = "Import"

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Find the cameras, or import them where the folder has them; Blender calls this."""
        self._scene_folder = scene_of_photos(self.filepath)
        if self._scene_folder is None:
            self.job = JOB
        return super().execute(context)

    def question(self) -> dict[str, Any]:
        """The request to inspect the folder, or to find the cameras."""
        if self._scene_folder is None:
            return super().question()
        return {"request": "inspect", "scene": str(self._scene_folder)}


CLASSES = (SWAG_OT_open_photos,)
