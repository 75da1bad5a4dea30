"""Merge splat objects."""

import bpy

from ..swag_blender import labels
from ..swag_blender.operator_base import SplatOperator


class SWAG_OT_merge_splats(SplatOperator):
    """Move the splats of the other selected objects into the active one"""

    bl_idname = "swag.merge_splats"
    bl_label = "Merge Splats"

    def change(self, context: bpy.types.Context, obj: bpy.types.Object) -> str:
        """Merge them."""
        return f"{labels.merge_selected(context, obj)} splats in {obj.name}."


CLASSES = (SWAG_OT_merge_splats,)
