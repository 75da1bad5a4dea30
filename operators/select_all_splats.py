"""Select all splats, none, or those that are not selected."""

from typing import Annotated

import bpy
from bpy.props import EnumProperty

from ..swag_blender import splat_selection
from ..swag_blender.blender_types import with_properties
from ..swag_blender.operator_base import SplatsOperator


@with_properties
class SWAG_OT_select_all_splats(SplatsOperator):
    """Select all splats that are shown, none, or those that are not selected"""

    bl_idname = "swag.select_all_splats"
    bl_label = "Select All Splats"

    action: Annotated[
        str,
        EnumProperty(
            name="Action",
            description="Which splats are selected afterwards",
            items=[
                ("SELECT", "All", "Select all splats"),
                ("DESELECT", "None", "Deselect all splats"),
                ("INVERT", "Invert", "Select those that are not selected, and deselect the others"),
            ],
        ),
    ]

    def work(self, context: bpy.types.Context) -> str:
        """Select them."""
        objects = splat_selection.edited_objects(context)
        return f"{sum(splat_selection.select_all(obj, self.action) for obj in objects)} splats selected."


CLASSES = (SWAG_OT_select_all_splats,)
