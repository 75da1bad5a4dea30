"""The panel Display: how viewports and renders show the splats of the active object."""

import bpy

from . import background, labels, splats, viewport
from .blender_types import present
from .display import display_of
from .nodes import splat_preview
from .sidebar import SwagPanel, draw_wrapped


class SWAG_PT_display(SwagPanel):
    """Panel of how the active splat object is shown."""

    bl_label = "Display"
    bl_parent_id = "SWAG_PT_result"
    bl_order = 20
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the active object has splats."""
        return splats.is_splats(context.active_object)

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the panel; Blender calls this."""
        layout, obj = present(self.layout), present(context.active_object)
        layout.use_property_split = True
        layout.use_property_decorate = False
        column = layout.column()
        for name in ("style", "density", "sh_degree"):
            column.prop(display_of(obj), name)
        if splat_preview.HAS_NATIVE:
            column.prop(display_of(obj), "exact")
        if splat_preview.is_native(obj):
            draw_wrapped(
                layout,
                "Renders are Blender's own: noisy with few samples, and lighter where splats overlap, because Blender "
                "blends light and training blended display values. Exact Shapes renders them as trained.",
                present(context.region).width,
                icon="INFO",
            )
        else:
            splat_preview.draw_input(column, obj, splat_preview.FACE_CAMERA)
        if labels.CONFIDENCE in splats.pointcloud_of(obj).attributes:
            column.prop(labels.labels_of(obj), "uncertain")
        if background.find([obj], None) is not None:
            column.prop(display_of(obj), "background")
        drawing = viewport.drawing()
        if drawing is not None and drawing.store.notice:
            draw_wrapped(layout, drawing.store.notice, present(context.region).width, icon="INFO")


register, unregister = bpy.utils.register_classes_factory((SWAG_PT_display,))
