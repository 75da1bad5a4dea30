"""Import a COLMAP scene: cameras with their photos, the sparse cloud, upright near the origin."""

import tempfile
from pathlib import Path
from typing import Annotated, Any

import bpy
from bpy.props import BoolProperty, StringProperty

from ..swag_blender import open_run, scene_import
from ..swag_blender.blender_types import OperatorResult, present, with_properties
from ..swag_blender.engine_process import Engine, EngineError
from ..swag_blender.job import Job, can_run_engine


@with_properties
class SWAG_OT_import_scene(Job):
    """Import the cameras, the photos and the points of a COLMAP reconstruction"""

    bl_idname = "swag.import_scene"
    bl_label = "Import COLMAP Scene"
    job = "Import"

    directory: Annotated[
        str,
        StringProperty(name="Folder", description="Folder with the photos and their COLMAP model", subtype="DIR_PATH"),
    ]
    filter_folder: Annotated[bool, BoolProperty(default=True, options={"HIDDEN"})]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the engine is there and no job runs."""
        return can_run_engine(cls, context)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Ask for the folder where none is given."""
        if self.directory:
            return self.execute(context)
        present(context.window_manager).fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Import: for a script until it is done, for a user without blocking the window."""
        if bpy.app.background or not self.options.is_invoke:
            return self.run_blocking(context)
        return self.run_modal(context)

    def start(self, context: bpy.types.Context) -> Engine:
        """Ask the engine to inspect the folder."""
        if not self.directory:
            raise EngineError("Choose the folder with the photos and their COLMAP model first.")
        self._scene = present(context.scene).name
        self._arrays = tempfile.TemporaryDirectory()
        engine = Engine()
        folder = str(Path(bpy.path.abspath(self.directory)).absolute())
        engine.send({"request": "inspect", "scene": folder, "arrays": self._arrays.name})
        return engine

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        """Build the objects."""
        with self._arrays:
            root, message = scene_import.add_to_scene(self._scene, event)
        open_run.adopt_splats(root, bpy.data.scenes[self._scene])
        return message


_parent_menu: Any = bpy.types.TOPBAR_MT_file_import  # as Any: the stubs declare another signature of append


def _menu(menu: Any, context: bpy.types.Context) -> None:
    menu.layout.operator(SWAG_OT_import_scene.bl_idname, text="COLMAP Scene (folder)")


def register() -> None:
    """Add the operator to File > Import."""
    _parent_menu.append(_menu)


def unregister() -> None:
    """Remove it from there."""
    _parent_menu.remove(_menu)


CLASSES = (SWAG_OT_import_scene,)
