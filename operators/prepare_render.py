"""Set up the scene so that a render shows the splats completely and in their own colours."""

from typing import Annotated

import bpy
from bpy.props import BoolProperty, EnumProperty

from ..swag_blender import splats
from ..swag_blender.blender_types import OperatorResult, present, with_properties
from ..swag_blender.render_setup import prepare_render


@with_properties
class SWAG_OT_prepare_render(bpy.types.Operator):
    """Set up Cycles or EEVEE for splats: transparency, colours, the background of the training, image size"""

    bl_idname = "swag.prepare_render"
    bl_label = "Set Up Render"
    bl_options = {"REGISTER", "UNDO"}

    engine: Annotated[
        str,
        EnumProperty(
            name="Engine",
            description="Render engine to set up",
            items=[
                ("CYCLES", "Cycles", "Sorts every splat by depth, among other objects and other splat objects too"),
                ("EEVEE", "EEVEE", "Uses the graphics card; draws one splat object completely in front of another"),
            ],
        ),
    ]
    display_values: Annotated[
        bool,
        BoolProperty(
            name="As Trained",
            description="Blend sRGB values under the view transform Raw, as training does, to compare renders with "
            "photos; other objects get wrong colours. Off: blend linear light, right beside other objects",
        ),
    ]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the scene has splats."""
        if not any(splats.is_splats(obj) for obj in present(context.scene).objects):
            cls.poll_message_set("There are no splats in the scene")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Set up the scene."""
        prepare_render(present(context.scene), self.display_values, self.engine)
        return {"FINISHED"}


CLASSES = (SWAG_OT_prepare_render,)
