"""Put ordinary objects into the water of the splats."""

import bpy
from bpy.props import BoolProperty

from ..swag_blender import splats, water
from ..swag_blender.nodes import water_shader


class SWAG_OT_water_objects(bpy.types.Operator):
    """Let the selected objects be seen through the water of the splats, by nodes in their materials"""

    bl_idname = "swag.water_objects"
    bl_label = "Put into the Water"
    bl_options = {"REGISTER", "UNDO"}

    remove: BoolProperty(name="Take Out", description="Take the water's nodes out of the materials again")

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Select objects with materials, in a scene whose splats have a water")
        return bool(_chosen(context)) and water.find(context.scene, context.active_object) is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        changed = set()
        for obj in _chosen(context):
            if not self.remove and not any(slot.material for slot in obj.material_slots):
                made = bpy.data.materials.new(obj.name)
                made.use_nodes = True
                obj.data.materials.append(made)
            changed |= {slot.material for slot in obj.material_slots if slot.material}
        done = 0
        for material in changed:
            material.use_nodes = True
            if self.remove:
                done += water_shader.take_out_of_water(material)
            else:
                source = water.find(context.scene, context.active_object)
                water_shader.put_under_water(material, water.node_group(source))
                done += water_shader.is_under_water(material)
        self.report({"INFO"}, f"{done} materials {'taken out of' if self.remove else 'put into'} the water.")
        return {"FINISHED"}


def _chosen(context: bpy.types.Context) -> list[bpy.types.Object]:
    return [obj for obj in context.selected_objects if hasattr(obj.data, "materials") and not splats.is_splats(obj)]


CLASSES = (SWAG_OT_water_objects,)
