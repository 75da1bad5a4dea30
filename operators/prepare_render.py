"""Set up the scene so that a render shows the splats completely and in their own colors."""

from typing import Annotated

import bpy
from bpy.props import BoolProperty, EnumProperty, IntProperty

from ..swag_blender import background, splats
from ..swag_blender.blender_types import OperatorResult, present, with_properties
from ..swag_blender.render_setup import SAMPLES, eevee_warning, prepare_render
from ..swag_blender.sidebar import draw_wrapped

DIALOG_WIDTH = 420
"""Width of the dialog in pixels at an interface scale of 1."""


@with_properties
class SWAG_OT_prepare_render(bpy.types.Operator):
    """Set up Cycles or EEVEE for splats: transparency, colors, the background of the run, image size"""

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
            "photos; other objects get wrong colors. Off: blend linear light, right beside other objects",
        ),
    ]
    world: Annotated[
        str,
        EnumProperty(
            name="World",
            description="What is behind the splats. Default: a world of your own is kept",
            items=[
                (
                    "RUN",
                    "Background of the Run",
                    "Open water or the background color of the run, as in films; your own world stays in the file",
                ),
                ("KEEP", "Keep", "Leave the world of the scene as it is"),
            ],
            options={"SKIP_SAVE"},
        ),
    ]
    samples: Annotated[
        int,
        IntProperty(
            name="Samples",
            description="Samples of a pixel: more of them smooth edges and shadows of other objects, and take longer",
            default=SAMPLES,
            min=1,
            soft_min=16,
            soft_max=64,
        ),
    ]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the scene has splats."""
        if not any(splats.is_splats(obj) for obj in present(context.scene).objects):
            cls.poll_message_set("There are no splats in the scene")
            return False
        return True

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Ask first; Blender calls this for buttons."""
        self.world = self._world(context)
        return present(context.window_manager).invoke_props_dialog(self, width=DIALOG_WIDTH)

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the dialog; Blender calls this."""
        layout = present(self.layout)
        layout.use_property_split = True
        for name in ("engine", "samples", "display_values"):
            layout.prop(self, name)
        if background.is_known(present(context.scene)):
            layout.prop(self, "world")
        warning = self._warning(context)
        if warning:
            scale = present(context.preferences).system.ui_scale
            draw_wrapped(layout, warning, int(DIALOG_WIDTH * scale), icon="ERROR")

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Set up the scene."""
        keep_world = self._world(context) == "KEEP"
        prepare_render(present(context.scene), self.display_values, self.engine, self.samples, keep_world)
        warning = self._warning(context)
        if warning:
            self.report({"WARNING"}, warning)
        return {"FINISHED"}

    def _world(self, context: bpy.types.Context) -> str:
        """The user's choice of the world; before it, the world of the user's own is kept."""
        if self.properties.is_property_set("world"):
            return self.world
        return "KEEP" if background.has_users_world(present(context.scene)) else "RUN"

    def _warning(self, context: bpy.types.Context) -> str:
        return eevee_warning(present(context.scene), self.samples) if self.engine == "EEVEE" else ""


CLASSES = (SWAG_OT_prepare_render,)
