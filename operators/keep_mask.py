"""Save the selected splats as a mask."""

from typing import Annotated

import bpy
from bpy.props import StringProperty

from ..swag_blender import labels
from ..swag_blender.blender_types import with_properties
from ..swag_blender.operator_base import SplatOperator


@with_properties
class SWAG_OT_keep_mask(SplatOperator):
    """Save the selection as an attribute mask:NAME, for geometry nodes"""

    bl_idname = "swag.keep_mask"
    bl_label = "Save as Mask"

    name: Annotated[str, StringProperty(name="Name", description="Name of the mask; empty: the words of the search")]

    def change(self, context: bpy.types.Context, obj: bpy.types.Object) -> str:
        """Save it."""
        return f"Saved as {labels.keep_mask(obj, self.name or labels.labels_of(obj).words)}."


CLASSES = (SWAG_OT_keep_mask,)
