"""Find a color chart in the photos of a run."""

from typing import Annotated, Any

import bpy
from bpy.props import StringProperty

from ..swag_blender import color_chart
from ..swag_blender.blender_types import present, with_properties
from ..swag_blender.job import Job, can_run_engine
from ..swag_blender.operator_base import active_run, splats_are_active


@with_properties
class SWAG_OT_find_color_chart(Job):
    """Look for a 24-patch color chart in the photos of the run, and compare its patches with their known colors"""

    bl_idname = "swag.find_color_chart"
    bl_label = "Find Color Chart"
    job = "Color chart"

    marked: Annotated[
        str,
        StringProperty(
            name="Marked", description="Photo and corners of the chart, from Mark Color Chart; empty: search",
            options={"HIDDEN", "SKIP_SAVE"},
        ),
    ]  # fmt: skip

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the active object has splats, the engine is there, and the job may start."""
        return can_run_engine(cls, context, active_run(context)) and splats_are_active(cls, context)

    def request(self, context: bpy.types.Context) -> dict[str, Any]:
        """The request for the run of the splats."""
        return color_chart.request(present(context.active_object), self.marked)

    def on_result(self, context: bpy.types.Context, event: dict[str, Any]) -> str:
        """Say how far the colors were off, and are."""
        return color_chart.describe(event)


CLASSES = (SWAG_OT_find_color_chart,)
