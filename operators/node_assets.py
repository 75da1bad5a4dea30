"""The node groups of splats and water for the asset browser."""

import bpy
from bpy.props import BoolProperty

from ..swag_blender import assets, water
from ..swag_blender.water_values import WaterValues


class SWAG_OT_node_assets(bpy.types.Operator):
    """Write the node groups of splats and water to a library, so that the asset browser has them in every file"""

    bl_idname = "swag.node_assets"
    bl_label = "Node Groups as Assets"
    bl_options = {"REGISTER"}

    remove: BoolProperty(
        name="Remove", description="Take the asset library away, from the disk too", options={"SKIP_SAVE"}
    )

    def execute(self, context: bpy.types.Context) -> set[str]:
        if self.remove:
            assets.remove()
            self.report({"INFO"}, "The asset library is removed.")
            return {"FINISHED"}
        values = water.water_of(water.find(context.scene, context.active_object)) or WaterValues()
        try:
            path = assets.install(values)
        except (OSError, RuntimeError) as error:
            self.report({"ERROR"}, f"The asset library cannot be written: {error}")
            return {"CANCELLED"}
        self.report({"INFO"}, f"The asset browser has them in the library {assets.LIBRARY}: {path}")
        return {"FINISHED"}


CLASSES = (SWAG_OT_node_assets,)
