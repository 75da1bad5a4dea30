"""Move the selected splats to a new object."""

import bpy

from ..swag_blender import labels, splats
from ..swag_blender.operator_base import SplatOperator


class SWAG_OT_separate_splats(SplatOperator):
    """Move the selected splats to a new object"""

    bl_idname = "swag.separate_splats"
    bl_label = "Separate Splats"

    def change(self, context: bpy.types.Context, obj: bpy.types.Object) -> str:
        """Move and select them."""
        part = labels.separate(obj)
        splats.select_only(context, [part])
        return f"{splats.count(part)} splats in {part.name}."


CLASSES = (SWAG_OT_separate_splats,)
