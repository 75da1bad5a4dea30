"""List the labels of the splats."""

from typing import Annotated

import bpy
from bpy.props import StringProperty

from ..swag_blender import labels
from ..swag_blender.blender_types import with_properties
from ..swag_blender.labelling import names_folder
from ..swag_blender.operator_base import SplatOperator


@with_properties
class SWAG_OT_read_labels(SplatOperator):
    """List the labels of the splats, with the names of the run they are from"""

    bl_idname = "swag.read_labels"
    bl_label = "Read Labels"

    directory: Annotated[
        str,
        StringProperty(
            name="Run", description="Run folder; empty: the folder of the run of the splats", subtype="DIR_PATH"
        ),
    ]

    def change(self, context: bpy.types.Context, obj: bpy.types.Object) -> str:
        """List them."""
        folder = bpy.path.abspath(self.directory) or names_folder(context, obj)
        return f"{labels.read_labels(obj, folder)} labels."


CLASSES = (SWAG_OT_read_labels,)
