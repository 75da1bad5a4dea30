"""Check which packages and devices the engine's Python has."""

from typing import Any

import bpy

from ..swag_blender.blender_types import OperatorResult
from ..swag_blender.engine_process import Engine, engine_python
from ..swag_blender.installation import remember_doctor
from ..swag_blender.job import Job, can_run_engine


class SWAG_OT_check_engine(Job):
    """List what the engine's Python has: packages with versions, processor, graphics card"""

    bl_idname = "swag.check_engine"
    bl_label = "Check Engine"
    bl_options = set()
    job = "Engine check"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the engine is there, and the job may start."""
        return can_run_engine(cls, context)

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Run without blocking the window."""
        return self.run(context)

    def start(self, context: bpy.types.Context) -> Engine:
        """Start the engine's doctor."""
        return Engine([engine_python(), "-m", "swag_engine.app.doctor"])

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        """Store what it found."""
        del event["event"]
        remember_doctor(context, event)
        return f"The engine is ready: torch {event['packages']['torch']}, training takes {event['auto']}."


CLASSES = (SWAG_OT_check_engine,)
