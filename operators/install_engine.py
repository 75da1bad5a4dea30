"""Make the Python environment that trains, in the extension's user folder."""

import sys
from typing import Any

import bpy

from ..swag_blender import engine_process
from ..swag_blender.engine_process import Engine, EngineError
from ..swag_blender.job import Job


class SWAG_OT_install_engine(Job, bpy.types.Operator):
    """Download the packages that training needs into a Python environment of their own"""

    bl_idname = "swag.install_engine"
    bl_label = "Install Engine"
    job = "Installation"

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_confirm(
            self,
            event,
            title="Install Engine",
            message=f"Downloads one to three gigabytes into {engine_process.environment_folder()}",
            confirm_text="Download",
        )

    def execute(self, context: bpy.types.Context) -> set[str]:
        return self.run_waiting(context) if bpy.app.background else self.run_modal(context)

    def start(self, context: bpy.types.Context) -> Engine:
        if not bpy.app.online_access:
            raise EngineError(
                "Online access is off: allow it in Preferences > System > Network, or name a Python with the engine."
            )
        root = engine_process.ROOT
        return Engine(
            [
                sys.executable,
                str(root / "swag_blender" / "make_environment.py"),
                bpy.utils.extension_path_user(engine_process.EXTENSION, path="engine", create=True),
                str(root / "requirements.txt"),
                str(root / "constraints.txt"),
            ]
        )

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        python, torch = event["versions"].split()
        return f"The engine is installed: Python {python}, torch {torch}."


CLASSES = (SWAG_OT_install_engine,)
