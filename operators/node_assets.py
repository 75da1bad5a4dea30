"""Add the node groups of splats and water to the asset browser."""

from typing import Annotated

import bpy
from bpy.props import BoolProperty

from ..swag_blender import assets
from ..swag_blender.blender_types import with_properties
from ..swag_blender.operator_base import ReportingOperator


@with_properties
class SWAG_OT_node_assets(ReportingOperator):
    """Write the node groups of splats and water to an asset library, for the asset browser in every file"""

    bl_idname = "swag.node_assets"
    bl_label = "Node Groups as Assets"
    bl_options = {"REGISTER"}

    remove: Annotated[
        bool,
        BoolProperty(name="Remove", description="Remove the asset library and its files", options={"SKIP_SAVE"}),
    ]

    def work(self, context: bpy.types.Context) -> str:
        """Write or remove the library."""
        if self.remove:
            assets.remove()
            return "The asset library is removed."
        path = assets.install(context)
        return f"The node groups are in the asset library {assets.LIBRARY}: {path}"


CLASSES = (SWAG_OT_node_assets,)
