"""Delete the splats outside the crop box."""

import bpy

from ..swag_blender import splat_selection
from ..swag_blender.operator_base import SplatsOperator


class SWAG_OT_delete_outside_crop(SplatsOperator):
    """Delete the splats outside the crop box for good; the box stays"""

    bl_idname = "swag.delete_outside_crop"
    bl_label = "Delete Outside Box"

    def work(self, context: bpy.types.Context) -> str:
        """Delete them."""
        return f"{splat_selection.delete_outside_crop(splat_selection.edited_objects(context))} splats deleted."


CLASSES = (SWAG_OT_delete_outside_crop,)
