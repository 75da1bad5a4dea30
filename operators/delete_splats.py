"""Delete the selected splats."""

import bpy

from ..swag_blender import splat_selection
from ..swag_blender.operator_base import SplatsOperator


class SWAG_OT_delete_splats(SplatsOperator):
    """Delete the selected splats; labels, masks and what is hidden stay for the others"""

    bl_idname = "swag.delete_splats"
    bl_label = "Delete Splats"

    def work(self, context: bpy.types.Context) -> str:
        """Delete them."""
        return f"{splat_selection.delete(splat_selection.edited_objects(context))} splats deleted."


CLASSES = (SWAG_OT_delete_splats,)
