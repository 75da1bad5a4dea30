"""Install the engine's Python environment in the extension's user folder."""

from typing import Any

import bpy

from ..swag_blender import engine_process
from ..swag_blender.blender_types import OperatorResult, present
from ..swag_blender.engine_process import Engine
from ..swag_blender.installation import can_install, refuse_larger_download, remember_doctor, start_installer
from ..swag_blender.job import Job
from ..swag_blender.preferences import expected_download, preferences


class SWAG_OT_install_engine(Job):
    """Download the packages that training needs into a Python environment of their own"""

    bl_idname = "swag.install_engine"
    bl_label = "Install Engine"
    bl_options = set()
    job = "Installation"
    heavy = goes_on = True

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether packages can be had and the job may start."""
        return can_install(cls, context)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Ask for confirmation."""
        where = "Installs from the folder of wheels" if preferences().wheels_folder else expected_download(context)
        return present(context.window_manager).invoke_confirm(
            self,
            event,
            title="Install Engine",
            message=f"{where}. Folder: {engine_process.environment_folder()}",
            confirm_text="Install",
        )

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Run without blocking the window."""
        return self.run(context)

    def start(self, context: bpy.types.Context) -> Engine:
        """Start the installer."""
        return start_installer(context, look_only=False)

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        """Store what the environment has. Raises InputError when only a torch larger than stated can be had."""
        if "doctor" not in event:
            refuse_larger_download(context, event)
        found = event["doctor"]
        remember_doctor(context, found)
        return f"The engine is installed: Python {found['python']}, torch {found['packages']['torch']}."


CLASSES = (SWAG_OT_install_engine,)
