"""Say what the folder of photographs holds, before anything is imported or trained."""

import tempfile
from typing import Any

import bpy

from ..swag_blender.engine_process import Engine, EngineError
from ..swag_blender.job import Job


class SWAG_OT_inspect_scene(Job, bpy.types.Operator):
    """Say what the folder holds: photographs, cameras, points, and what is wrong with them"""

    bl_idname = "swag.inspect_scene"
    bl_label = "Check Photographs"
    bl_options = {"REGISTER"}
    job = "Check"

    def start(self, context: bpy.types.Context) -> Engine:
        swag = context.scene.swag
        swag.found = ""
        if not swag.scene_folder:
            raise EngineError("Choose the folder with the photographs and their COLMAP model first.")
        self._scene = context.scene.name
        self._arrays = tempfile.TemporaryDirectory()
        engine = Engine()
        engine.send({"request": "inspect", "scene": swag.scene_path, "arrays": self._arrays.name})
        return engine

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        self._arrays.cleanup()
        found = describe(event)
        if scene := bpy.data.scenes.get(self._scene):
            scene.swag.found = found
        return f"{found.splitlines()[0]}."


def describe(result: dict[str, Any]) -> str:
    """The result of an `inspect` request in lines for the panel: one of figures, then the warnings."""
    first = (
        f"{result['registered']} of {result['images']} photographs have a camera, {result['points']['count']} points"
    )
    return "\n".join((first, *result["warnings"]))


CLASSES = (SWAG_OT_inspect_scene,)
