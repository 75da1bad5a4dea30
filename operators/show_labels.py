"""Show all labels of the splats."""

import bpy

from ..swag_blender import labels
from ..swag_blender.operator_base import SplatOperator


class SWAG_OT_show_labels(SplatOperator):
    """Show all labels"""

    bl_idname = "swag.show_labels"
    bl_label = "Show All"

    def change(self, context: bpy.types.Context, obj: bpy.types.Object) -> str:
        """Show them."""
        labels.show_all(obj)
        return ""


CLASSES = (SWAG_OT_show_labels,)
