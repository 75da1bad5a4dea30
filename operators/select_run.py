"""Select the splats of a run."""

from typing import Annotated

import bpy
from bpy.props import StringProperty

from ..swag_blender import splats
from ..swag_blender.blender_types import OperatorResult, present, with_properties


@with_properties
class SWAG_OT_select_run(bpy.types.Operator):
    """Select this run and show its figures"""

    bl_idname = "swag.select_run"
    bl_label = "Select Run"
    bl_options = {"UNDO", "INTERNAL"}

    name: Annotated[str, StringProperty(name="Name", description="Name of the splat object of the run")]

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Select its object."""
        obj = present(context.view_layer).objects.get(self.name)
        if obj is None:
            self.report({"ERROR"}, f"{self.name} is not in this view layer: choose another run.")
            return {"CANCELLED"}
        splats.select_only(context, [obj])
        return {"FINISHED"}


CLASSES = (SWAG_OT_select_run,)
