"""Select the splats of one label."""

from typing import Annotated

import bpy
from bpy.props import BoolProperty, IntProperty

from ..swag_blender import labels
from ..swag_blender.blender_types import OperatorResult, with_properties
from ..swag_blender.operator_base import SplatOperator


@with_properties
class SWAG_OT_select_label(SplatOperator):
    """Select the splats of this label; with Shift in addition to the selection"""

    bl_idname = "swag.select_label"
    bl_label = "Select Label"

    number: Annotated[int, IntProperty(name="Label")]
    extend: Annotated[bool, BoolProperty(name="Extend")]

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Extend the selection with Shift."""
        self.extend = event.shift
        return self.execute(context)

    def change(self, context: bpy.types.Context, obj: bpy.types.Object) -> str:
        """Select them."""
        return f"{labels.select_label(obj, self.number, self.extend)} splats selected."


CLASSES = (SWAG_OT_select_label,)
