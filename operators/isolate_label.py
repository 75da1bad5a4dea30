"""Show one label of the splats alone."""

from typing import Annotated

import bpy
from bpy.props import IntProperty

from ..swag_blender import labels
from ..swag_blender.blender_types import with_properties
from ..swag_blender.operator_base import SplatOperator


@with_properties
class SWAG_OT_isolate_label(SplatOperator):
    """Show this label alone; click again to show all labels"""

    bl_idname = "swag.isolate_label"
    bl_label = "Isolate"

    number: Annotated[int, IntProperty(name="Label")]

    def change(self, context: bpy.types.Context, obj: bpy.types.Object) -> str:
        """Show it alone."""
        labels.isolate(obj, self.number)
        return ""


CLASSES = (SWAG_OT_isolate_label,)
