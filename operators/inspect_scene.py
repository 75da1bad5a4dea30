"""Check the folder of photos before anything is imported or trained."""

import tempfile
from typing import Any

from ..swag_blender import scene_import
from ..swag_blender.job import SceneJob
from ..swag_blender.properties import SwagScene


class SWAG_OT_inspect_scene(SceneJob):
    """Count the photos, cameras and points of the folder, and list the problems found"""

    bl_idname = "swag.inspect_scene"
    bl_label = "Check Photos"
    job = "Check"

    def question(self, swag: SwagScene) -> dict[str, Any]:
        """The request with a folder for the engine's arrays."""
        swag.found = ""
        self._arrays = tempfile.TemporaryDirectory()
        settings = swag.train_settings()
        self._asked = swag.sized_by(settings)
        return {"request": "inspect", "arrays": self._arrays.name, "settings": settings}

    def take(self, swag: SwagScene, event: dict[str, Any]) -> str:
        """Show what was found."""
        self._arrays.cleanup()
        swag.found = scene_import.describe(event)
        swag.keep_sizes(self._asked, event["sizes"])
        return f"{swag.found.splitlines()[0]}."


CLASSES = (SWAG_OT_inspect_scene,)
