"""Show ordinary objects through the fitted water of the splats."""

from typing import Annotated

import bpy
from bpy.props import BoolProperty

from ..swag_blender import water
from ..swag_blender.blender_types import OperatorResult, present, with_properties


@with_properties
class SWAG_OT_water_objects(bpy.types.Operator):
    """Show the selected objects through the water of the splats, by nodes in their materials"""

    bl_idname = "swag.water_objects"
    bl_label = "Add Water to Objects"
    bl_options = {"REGISTER", "UNDO"}

    remove: Annotated[bool, BoolProperty(name="Remove", description="Remove the water's nodes from the materials")]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether objects with materials are selected and the splats have a water."""
        if water.find(present(context.scene), context.active_object) is None:
            cls.poll_message_set("No splats in the scene have a fitted water")
            return False
        if not water.objects_with_materials(context):
            cls.poll_message_set("Select objects with materials first")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Add or remove the nodes."""
        objects = water.objects_with_materials(context)
        if self.remove:
            count, done = water.remove_from_objects(objects), "removed from"
        else:
            source = present(water.find(present(context.scene), context.active_object))
            count, done = water.add_to_objects(objects, source), "added to"
        self.report({"INFO"}, f"Water {done} {count} materials.")
        return {"FINISHED"}


CLASSES = (SWAG_OT_water_objects,)
