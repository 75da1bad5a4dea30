"""Look up the size of the engine's Python environment without downloading it."""

from typing import Any

import bpy

from ..swag_blender.blender_types import OperatorResult
from ..swag_blender.engine_process import Engine
from ..swag_blender.installation import can_install, remember_download, start_installer
from ..swag_blender.job import Job
from ..swag_blender.preferences import CUDA_INSTEAD
from ..swag_blender.properties import status_of


class SWAG_OT_look_up_engine(Job):
    """Look up which build of torch would be installed and how much would be downloaded, without downloading it"""

    bl_idname = "swag.look_up_engine"
    bl_label = "Look Up Size of Engine"
    bl_options = set()
    job = "Look-up"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether packages can be had and the job may start."""
        return can_install(cls, context)

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Run without blocking the window."""
        return self.run(context)

    def start(self, context: bpy.types.Context) -> Engine:
        """Start the installer in its mode that only looks up."""
        return start_installer(context, look_only=True)

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        """Describe the packages."""
        left = remember_download(context, event)
        why = f"{CUDA_INSTEAD} " if status_of(context).cuda_instead else ""
        return (
            f"{why}torch {event['torch']} and {event['packages'] - 1} other packages, {event['bytes'] / 1e6:.0f} MB; "
            f"{left / 1e6:.0f} MB of them are to be downloaded."
        )


CLASSES = (SWAG_OT_look_up_engine,)
