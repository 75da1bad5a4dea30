"""Crop splats by a new box."""

import bpy

from ..swag_blender import crop_box, splat_selection, splats
from ..swag_blender.operator_base import SplatsOperator


class SWAG_OT_add_crop_box(SplatsOperator):
    """Add a box around the splats that limits what is shown, rendered and exported; move, rotate and scale it"""

    bl_idname = "swag.add_crop_box"
    bl_label = "Add Crop Box"

    def work(self, context: bpy.types.Context) -> str:
        """Add it and select it, so that it can be moved at once."""
        box = crop_box.add_crop_box(context, splat_selection.edited_objects(context))
        splats.select_only(context, [box])
        return ""


CLASSES = (SWAG_OT_add_crop_box,)
