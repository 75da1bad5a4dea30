"""Show the figures of an effect of the plan."""

from typing import Annotated, Any

import bpy
from bpy.props import StringProperty

from ..swag_blender.blender_types import OperatorResult, with_properties
from ..swag_blender.effects import tooltip
from ..swag_blender.properties import swag_of


@with_properties
class SWAG_OT_show_effect(bpy.types.Operator):
    """Show what was measured of this effect, and what it needs"""

    bl_idname = "swag.show_effect"
    bl_label = "Show Effect"
    bl_options = {"INTERNAL"}

    effect: Annotated[str, StringProperty(name="Effect", description="Name of the effect in the plan")]

    @classmethod
    def description(cls, context: bpy.types.Context, properties: Any) -> str:
        """Tooltip: what the effect does, and the decision; Blender calls this."""
        return tooltip(swag_of(context.scene).plan, properties.effect)

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Select its line."""
        plan = swag_of(context.scene).plan
        plan.active = max(0, plan.lines.find(self.effect))
        return {"FINISHED"}


CLASSES = (SWAG_OT_show_effect,)
