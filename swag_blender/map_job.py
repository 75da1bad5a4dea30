"""Base class of the operators that make maps and measurements."""

from typing import Any

import bpy

from . import maps
from .blender_types import present
from .job import Job, can_run_engine
from .operator_base import active_run, splats_are_active


class MapJob(Job):
    """Job that makes one kind of map of the run of the active splat object and shows it; it gives `kind`."""

    job = maps.JOB
    kind: str

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the active object has splats, the engine is there, and the job may start."""
        return splats_are_active(cls, context) and can_run_engine(cls, context, active_run(context))

    def request(self, context: bpy.types.Context) -> dict[str, Any]:
        """The request for the run of the splats."""
        self._object = present(context.active_object).name
        return maps.make_request(context, self.kind)

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        """Show the map."""
        return maps.show_map(self._object, event)
