"""Bring a COLMAP scene into Blender: cameras with their photographs, the sparse cloud, upright near the origin."""

import tempfile
from pathlib import Path
from typing import Any

import bpy
from bpy.props import StringProperty

from ..swag_blender import scene_import
from ..swag_blender.engine_process import Engine, EngineError
from ..swag_blender.job import Job
from .inspect_scene import describe


class SWAG_OT_import_scene(Job, bpy.types.Operator):
    """Bring in the cameras, the photographs and the points of a COLMAP reconstruction"""

    bl_idname = "swag.import_scene"
    bl_label = "Import COLMAP Scene"
    bl_options = {"REGISTER", "UNDO"}
    job = "Import"

    directory: StringProperty(
        name="Folder", description="Folder with the photographs and their COLMAP model", subtype="DIR_PATH"
    )
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if self.directory:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        # A call from a script returns when the scene is there; the user's window stays free.
        follow = self.options.is_invoke and not bpy.app.background
        if not follow:
            return self.run_waiting(context)
        scene_import.show_colors(context.screen)
        return self.run_modal(context)

    def start(self, context: bpy.types.Context) -> Engine:
        if not self.directory:
            raise EngineError("Choose the folder with the photographs and their COLMAP model first.")
        self._scene = context.scene.name
        self._arrays = tempfile.TemporaryDirectory()
        engine = Engine()
        folder = str(Path(bpy.path.abspath(self.directory)).absolute())
        engine.send({"request": "inspect", "scene": folder, "arrays": self._arrays.name})
        return engine

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        scene = bpy.data.scenes.get(self._scene)
        if not scene:
            raise EngineError(f"The scene {self._scene} is gone; import again.")
        with self._arrays:
            scene_import.import_scene(event, scene)
        scene.swag.scene_folder = event["scene"]
        scene.swag.found = describe(event)
        return f"{scene.swag.found.splitlines()[0]}."


def _menu(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    menu.layout.operator(SWAG_OT_import_scene.bl_idname, text="COLMAP Scene (folder)")


def register() -> None:
    bpy.types.TOPBAR_MT_file_import.append(_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_import.remove(_menu)


CLASSES = (SWAG_OT_import_scene,)
