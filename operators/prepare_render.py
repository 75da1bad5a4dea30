"""Set the scene up so that a render in Cycles or EEVEE shows the splats fully and in their own colours."""

import bpy
from bpy.props import BoolProperty, EnumProperty

from ..swag_blender import scene_import, splats, water
from ..swag_blender.nodes import splat_preview


class SWAG_OT_prepare_render(bpy.types.Operator):
    """Set up Cycles or EEVEE for splats: all layers, true colours, the trained background, the picture's size"""

    bl_idname = "swag.prepare_render"
    bl_label = "Set Up Render"
    bl_options = {"REGISTER", "UNDO"}

    engine: EnumProperty(
        name="Engine",
        description="What renders",
        items=[
            ("CYCLES", "Cycles", "Every splat is in its depth among other objects, and splats of other objects"),
            ("EEVEE", "EEVEE", "Drawn by the graphics card; of two splat objects one is wholly before the other"),
        ],
    )
    display_values: BoolProperty(
        name="As Trained",
        description="Blend display values under the view transform Raw: the engine's own picture, for comparing with "
        "photographs; other objects in the picture look wrong. Off: blend light, right beside other objects",
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("There are no splats in the scene")
        return any(splats.is_splats(obj) for obj in context.scene.objects)

    def execute(self, context: bpy.types.Context) -> set[str]:
        scene = context.scene
        splat_preview.prepare_render(scene, self.display_values, self.engine)
        water.set_world(scene, self.display_values)
        if scene.camera and scene_import.SIZE_KEY in scene.camera:
            scene_import.look_through(scene, scene.camera)
        return {"FINISHED"}


CLASSES = (SWAG_OT_prepare_render,)
