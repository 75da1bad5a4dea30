"""Hide the selected splats, or all others."""

from typing import Annotated

import bpy
from bpy.props import BoolProperty

from ..swag_blender import splat_selection
from ..swag_blender.blender_types import with_properties
from ..swag_blender.operator_base import SplatsOperator


@with_properties
class SWAG_OT_hide_splats(SplatsOperator):
    """Hide the selected splats in the viewport and in renders"""

    bl_idname = "swag.hide_splats"
    bl_label = "Hide Splats"

    unselected: Annotated[
        bool, BoolProperty(name="Unselected", description="Hide the splats that are not selected instead")
    ]

    def work(self, context: bpy.types.Context) -> str:
        """Hide them."""
        return f"{splat_selection.hide(splat_selection.edited_objects(context), self.unselected)} splats hidden."


CLASSES = (SWAG_OT_hide_splats,)
