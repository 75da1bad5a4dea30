"""Show hidden splats again."""

import bpy

from ..swag_blender import splat_selection
from ..swag_blender.operator_base import SplatsOperator


class SWAG_OT_reveal_splats(SplatsOperator):
    """Show the hidden splats again and select them; hidden labels stay hidden"""

    bl_idname = "swag.reveal_splats"
    bl_label = "Show Hidden Splats"

    def work(self, context: bpy.types.Context) -> str:
        """Show them."""
        objects = splat_selection.edited_objects(context)
        return f"{sum(splat_selection.reveal(obj) for obj in objects)} splats shown again."


CLASSES = (SWAG_OT_reveal_splats,)
