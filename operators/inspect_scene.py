"""Say what the folder of photographs holds, before anything is imported or trained."""

import tempfile
from typing import Any

import bpy

from ..swag_blender.engine_process import EngineError, run_request


class SWAG_OT_inspect_scene(bpy.types.Operator):
    """Say what the folder holds: photographs, cameras, points, and what is wrong with them"""

    bl_idname = "swag.inspect_scene"
    bl_label = "Check Photographs"
    bl_options = {"REGISTER"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        swag = context.scene.swag
        swag.found = ""
        try:
            if not swag.scene_folder:
                raise EngineError("Choose the folder with the photographs and their COLMAP model first.")
            with tempfile.TemporaryDirectory() as arrays:
                result = run_request({"request": "inspect", "scene": swag.scene_path, "arrays": arrays})
        except EngineError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        swag.found = describe(result)
        self.report({"INFO"}, swag.found.splitlines()[0])
        return {"FINISHED"}


def describe(result: dict[str, Any]) -> str:
    """The result of an `inspect` request in lines for the panel: one of figures, then the warnings."""
    first = (
        f"{result['registered']} of {result['images']} photographs have a camera, {result['points']['count']} points"
    )
    return "\n".join((first, *result["warnings"]))


CLASSES = (SWAG_OT_inspect_scene,)
